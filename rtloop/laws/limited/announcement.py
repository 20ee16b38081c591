"""Announcement of the law whose code runs next, so that the parent process can name it if it has to be killed."""

from __future__ import annotations

from collections.abc import Callable

_listeners: list[Callable[[str, str], None]] = []
"""Receivers of announcements: one in a limited process, none in any other."""


def listen(listener: Callable[[str, str], None]) -> None:
    """Make this process a limited one: `listener` gets kind and file of each law that is announced."""
    _listeners.append(listener)


def is_limited() -> bool:
    """Return whether this is a limited process, which may run the code of a user law for the first time."""
    return bool(_listeners)


def announce(kind: str, file: str) -> None:
    """Tell the listeners that the code of this law runs next."""
    for listener in _listeners:
        listener(kind, file)

"""The law whose code is about to run: told to the process that limits this one, so that it can name the culprit."""

from __future__ import annotations

from collections.abc import Callable

_listeners: list[Callable[[str, str], None]] = []
"""One in a limited process, none in any other."""


def listen(listener: Callable[[str, str], None]) -> None:
    """Make this process a limited one: `listener` gets kind and file of each law that is announced."""
    _listeners.append(listener)


def is_limited() -> bool:
    """Whether this process may run the code of somebody's own law for the first time."""
    return bool(_listeners)


def announce(kind: str, file: str) -> None:
    """Say that the code of this law runs next."""
    for listener in _listeners:
        listener(kind, file)

"""Presence of a request's client: a measurement that moves an axis ends when its client disconnects."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from rtloop.service.desk import Refusal

_is_waiting: ContextVar[Callable[[], bool]] = ContextVar("waits", default=lambda: True)


class ClientDisconnected(Refusal):
    """The client's connection has ended."""


@contextmanager
def work_for_client(is_waiting: Callable[[], bool]) -> Iterator[None]:
    """Do the work within for a client, also in threads that copy its context; `is_waiting` tells whether the client is
    still connected.
    """
    token = _is_waiting.set(is_waiting)
    try:
        yield
    finally:
        _is_waiting.reset(token)


def is_client_waiting() -> bool:
    """Return whether the client is still connected; True for work without a client."""
    return _is_waiting.get()()


def require_client(activity: str) -> None:
    """Raise ClientDisconnected, which names `activity`, if the client has disconnected."""
    if not is_client_waiting():
        raise ClientDisconnected(f"{activity}: the client has gone")

"""Whether the client of a request still waits for its answer: what moves an axis for a client ends with that client."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from rtloop.service.desk import Refused

_waits: ContextVar[Callable[[], bool]] = ContextVar("waits", default=lambda: True)


class ClientGone(Refused):
    """The connection of the client that asked has ended."""


@contextmanager
def on_behalf_of(waits: Callable[[], bool]) -> Iterator[None]:
    """Work for a client; `waits` tells whether its connection still stands. Threads that get the context know it."""
    token = _waits.set(waits)
    try:
        yield
    finally:
        _waits.reset(token)


def client_waits() -> bool:
    """Whether the client still waits; True where the work is for no client."""
    return _waits.get()()


def require_client(activity: str) -> None:
    """Raise ClientGone where nobody waits for the result of `activity` any more."""
    if not client_waits():
        raise ClientGone(f"{activity}: the client has gone")

"""Presence of a request's client: a measurement that moves an axis ends when its client disconnects."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from contextvars import ContextVar

from rtloop.service.background import set_in_context
from rtloop.service.desk import Refusal

_is_waiting: ContextVar[Callable[[], bool]] = ContextVar("waits", default=lambda: True)


class ClientDisconnected(Refusal):
    """The client's connection has ended."""


def bind_client(is_waiting: Callable[[], bool]) -> AbstractContextManager[None]:
    """Return a context manager that makes `is_waiting` the answer of `is_client_waiting` for the work within.

    `is_waiting` returns whether the client is still connected. Threads that copy the context get this answer, too.
    """
    return set_in_context(_is_waiting, is_waiting)


def is_client_waiting() -> bool:
    """Return whether the client is still connected; True for work without a client."""
    return _is_waiting.get()()


def require_client(activity: str) -> None:
    """Raise ClientDisconnected, which names `activity`, if the client has disconnected."""
    if not is_client_waiting():
        raise ClientDisconnected(f"{activity}: the client has closed its connection")

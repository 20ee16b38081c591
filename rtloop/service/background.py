"""Helpers of the service: periodic work in a thread, and values of a context."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

T = TypeVar("T")


@contextmanager
def repeat_every(period_s: float, action: Callable[[], object]) -> Iterator[None]:
    """Call `action` every `period_s` in a separate thread during the work within, first after one period.

    A call in progress is not awaited at the end; an exception of `action` ends the repetition.
    """
    end_event = threading.Event()

    def work() -> None:
        """Call `action` every `period_s` until `end_event`."""
        while not end_event.wait(period_s):
            action()

    threading.Thread(target=work, daemon=True).start()
    try:
        yield
    finally:
        end_event.set()


@contextmanager
def set_in_context(variable: ContextVar[T], value: T) -> Iterator[None]:
    """Set a context variable during the work within, also for threads that copy its context."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)

"""Helpers of the service: periodic work in a thread, and values of a context."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from rtloop.foundation import timing

T = TypeVar("T")


@contextmanager
def repeat_every(period_s: float, action: Callable[[], object]) -> Iterator[None]:
    """Call `action` again and again in a separate thread during the work within, after a pause of `period_s` each time.

    The first pause comes before the first call. A call in progress is not awaited at the end; an exception of `action`
    ends the repetition, and is not raised in the work.
    """
    end_event = timing.event()

    def work() -> None:
        """Call `action` after each pause of `period_s` until `end_event` is set."""
        while not end_event.wait(period_s):
            action()

    timing.start_thread(work)
    try:
        yield
    finally:
        end_event.set()


@contextmanager
def set_in_context(variable: ContextVar[T], value: T) -> Iterator[None]:
    """Set a context variable during the work within, also for threads that copy its context; then restore its value."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)

"""Clocks, pauses, locks and threads: the one place where the service, its supervisor, recorder, panel and clients take
them.

They are the standard library's, unless a test owns time: it sets a `Source` of its own, under which one thread runs at
a time and no second passes by itself. Loops, drivers and boards keep real time by themselves.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass


def _start_thread(work: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


@dataclass(frozen=True)
class Source:
    """Where time comes from: by default the standard library."""

    monotonic_s: Callable[[], float] = time.monotonic
    unix_s: Callable[[], float] = time.time
    sleep: Callable[[float], None] = time.sleep
    lock: Callable[[], threading.Lock] = threading.Lock
    reentrant_lock: Callable[[], AbstractContextManager[object]] = threading.RLock
    event: Callable[[], threading.Event] = threading.Event
    start_thread: Callable[[Callable[[], object]], threading.Thread] = _start_thread


source = Source()
"""The source in force; only a test replaces it."""


def monotonic_s() -> float:
    """Return the time in s since some moment; it never goes back."""
    return source.monotonic_s()


def unix_s() -> float:
    """Return the time in s since 1970."""
    return source.unix_s()


def sleep(seconds: float) -> None:
    """Let `seconds` pass."""
    source.sleep(seconds)


def lock() -> threading.Lock:
    """Return a new lock."""
    return source.lock()


def reentrant_lock() -> AbstractContextManager[object]:
    """Return a new lock, which the thread that holds it may take again."""
    return source.reentrant_lock()


def event() -> threading.Event:
    """Return a new event."""
    return source.event()


def start_thread(work: Callable[[], object]) -> threading.Thread:
    """Start a daemon that does `work`."""
    return source.start_thread(work)

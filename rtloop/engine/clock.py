"""Clocks that pace the ticks. Each is a pair of C functions, `wait` and `now`, with a context.

`wait` fills timing[0] = deadline and timing[1] = wake, both in ns since the start, timing[2] = whole periods skipped,
timing[3] = wake in ns of CLOCK_MONOTONIC; `now` fills timing[0] = ns since the start. A non-zero result of `wait` ends
the run. A clock without `now`, 0, measures no times: they are NaN.

Paced: absolute deadlines on a fixed grid, sleep until `spin_ns` before the deadline, then spin. A tick that wakes
late runs once; periods that have passed entirely are skipped and never caught up in a burst.
Unpaced: virtual time. No clock is read and measured times are NaN; the loop waits for the recorder alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.foundation.native.atomics import load_acquire
from rtloop.foundation.native.compiled import cfunc
from rtloop.foundation.native.monotonic import SECOND_NS, monotonic_ns, sleep_for, sleep_until
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, carray

BACKPRESSURE_NS = 50_000

CONTEXT = np.dtype(
    [
        ("timespec", np.int64, (2,)),
        ("timespec_address", np.int64),
        ("start_ns", np.int64),
        ("period_ns", np.float64),
        ("spin_ns", np.int64),
        ("index", np.int64),
        ("head_address", np.int64),
        ("words_address", np.int64),
        ("cursor_word", np.int64),
        ("slack_ticks", np.int64),
    ],
    align=True,
)


class Clock(NamedTuple):
    """Addresses of `wait`, `now` (0 for none) and their context. The context's array must outlive the clock."""

    wait: int
    now: int
    context: int


@cfunc(SIGNATURE)
def paced_now(context, timing):
    """Set timing[0] to the ns since the start, by CLOCK_MONOTONIC; return 0."""
    clock = carray(context, 1, CONTEXT)[0]
    carray(timing, 4)[0] = float(monotonic_ns(clock.timespec_address) - clock.start_ns)
    return 0


@cfunc(SIGNATURE)
def paced_wait(context, timing):
    """Sleep, then spin, until the next deadline of the grid; set `timing` and return 0.

    `timing` (4,) gets deadline and wake in ns since the start, the number of whole periods that had passed and are
    skipped, and the wake in ns of CLOCK_MONOTONIC.
    """
    clock = carray(context, 1, CONTEXT)[0]
    out = carray(timing, 4)
    now_ns = monotonic_ns(clock.timespec_address)
    deadline_ns = clock.start_ns + np.int64(clock.index * clock.period_ns)
    missed = 0
    if now_ns > deadline_ns:
        missed = np.int64((now_ns - deadline_ns) / clock.period_ns)
        clock.index += missed
        deadline_ns = clock.start_ns + np.int64(clock.index * clock.period_ns)
    while now_ns < deadline_ns - clock.spin_ns:
        now_ns = sleep_until(deadline_ns - clock.spin_ns, clock.timespec_address)
    while now_ns < deadline_ns:
        now_ns = monotonic_ns(clock.timespec_address)
    clock.index += 1
    out[0] = float(deadline_ns - clock.start_ns)
    out[1] = float(now_ns - clock.start_ns)
    out[2] = float(missed)
    out[3] = float(now_ns)
    return 0


@cfunc(SIGNATURE)
def unpaced_wait(context, timing):
    """Advance virtual time to the next tick, once the recorder is at most `slack_ticks` behind; set `timing`, return 0.

    `timing` (4,) gets the deadline in ns since the start, NaN, 0 skipped periods and NaN: no wake is measured.
    """
    clock = carray(context, 1, CONTEXT)[0]
    head = carray(address_pointer(clock.head_address), 1, np.uint64)
    words = carray(address_pointer(clock.words_address), 64, np.uint64)
    while np.int64(head[0] - load_acquire(words, clock.cursor_word)) > clock.slack_ticks:
        sleep_for(BACKPRESSURE_NS, clock.timespec_address)
    out = carray(timing, 4)
    out[0] = float(np.int64(clock.index * clock.period_ns))
    out[1] = np.nan
    out[2] = 0.0
    out[3] = np.nan
    clock.index += 1
    return 0


def clock_context(rate_hz: float) -> np.recarray:
    """Return a new context of a clock, one CONTEXT record (1,), with the period of `rate_hz` and the start at 0."""
    context = np.zeros(1, CONTEXT).view(np.recarray)
    context.timespec_address = context.ctypes.data + CONTEXT.fields["timespec"][1]  # type: ignore[index]
    context.period_ns = SECOND_NS / rate_hz
    return context


def paced_clock(context: np.recarray, spin_us: float) -> Clock:
    """Return the clock of real time, which spins for the last `spin_us` µs before each deadline.

    `context`, of `clock_context`, gets this setting and must outlive the clock. Before use, set `context.start_ns` to
    the first deadline, in ns of CLOCK_MONOTONIC.
    """
    context.spin_ns = round(spin_us * 1000)
    return Clock(paced_wait.address, paced_now.address, context.ctypes.data)


def unpaced_clock(context: np.recarray, head: np.ndarray, words: np.ndarray, cursor_word: int, slack: int) -> Clock:
    """Return the clock of virtual time, whose ticks are at most `slack` ahead of the reader at `words[cursor_word]`.

    `head` (1,) has the number of ticks published. `context`, of `clock_context`, gets these addresses; all arrays must
    outlive the clock.
    """
    context.head_address, context.words_address = head.ctypes.data, words.ctypes.data
    context.cursor_word, context.slack_ticks = cursor_word, slack
    return Clock(unpaced_wait.address, 0, context.ctypes.data)

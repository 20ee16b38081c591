"""CLOCK_MONOTONIC for compiled code: its time, and sleeping until a time or for a duration.

Functions of the C library are called by name: a ctypes pointer in a global variable would defeat the compilation
cache. Each kernel takes the address of two int64 as scratch memory, `timespec`, and allocates nothing.
"""

from __future__ import annotations

import time

import numpy as np

from rtloop.foundation.native import uncompiled
from rtloop.foundation.native.compiled import c_library_function, jit
from rtloop.foundation.native.pointers import address_pointer, carray

CLOCK_MONOTONIC = 1
TIMER_ABSTIME = 1
SECOND_NS = 1_000_000_000


def _gettime_in_python(clock: int, timespec_address: int) -> int:
    """Write seconds and nanoseconds of a clock to an address, like the C library's `clock_gettime`; return 0."""
    uncompiled.carray(timespec_address, 2, np.int64)[:] = divmod(time.clock_gettime_ns(clock), SECOND_NS)
    return 0


def _nanosleep_in_python(clock: int, flags: int, timespec_address: int, _: int) -> int:
    """Sleep like the C library's `clock_nanosleep` with CLOCK_MONOTONIC; return 0."""
    seconds, ns = uncompiled.carray(timespec_address, 2, np.int64).tolist()
    began_ns = time.clock_gettime_ns(clock) if flags == TIMER_ABSTIME else 0
    time.sleep(max(seconds * SECOND_NS + ns - began_ns, 0) / SECOND_NS)
    return 0


_clock_gettime = c_library_function("clock_gettime", "int32(int32, intp)", _gettime_in_python)
_clock_nanosleep = c_library_function("clock_nanosleep", "int32(int32, int32, intp, intp)", _nanosleep_in_python)


@jit
def monotonic_ns(timespec_address):
    """Return the time in ns of CLOCK_MONOTONIC; two int64 at `timespec_address` are overwritten."""
    _clock_gettime(CLOCK_MONOTONIC, timespec_address)
    timespec = carray(address_pointer(timespec_address), 2, np.int64)
    return timespec[0] * SECOND_NS + timespec[1]


@jit
def sleep_until(wake_ns, timespec_address):
    """Sleep until `wake_ns` or a signal; return the time afterwards in ns of CLOCK_MONOTONIC."""
    _sleep(wake_ns, TIMER_ABSTIME, timespec_address)
    return monotonic_ns(timespec_address)


@jit
def sleep_for(duration_ns, timespec_address):
    """Sleep for `duration_ns` or until a signal."""
    _sleep(duration_ns, 0, timespec_address)


@jit
def _sleep(time_ns, flags, timespec_address):
    """Sleep until `time_ns` with `flags` = TIMER_ABSTIME, for `time_ns` with 0; a signal ends the sleep."""
    timespec = carray(address_pointer(timespec_address), 2, np.int64)
    timespec[0] = time_ns // SECOND_NS
    timespec[1] = time_ns % SECOND_NS
    _clock_nanosleep(CLOCK_MONOTONIC, flags, timespec_address, 0)

"""CLOCK_MONOTONIC for compiled code: read it, and sleep until an absolute time.

libc is reached by name: a ctypes pointer held as a global would defeat the compilation cache. Both kernels take the
address of two int64 as their scratch `timespec`, so that they allocate nothing.
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
    """As `clock_gettime`."""
    uncompiled.carray(timespec_address, 2, np.int64)[:] = divmod(time.clock_gettime_ns(clock), SECOND_NS)
    return 0


_clock_gettime = c_library_function("clock_gettime", "int32(int32, intp)", _gettime_in_python)
_clock_nanosleep = c_library_function("clock_nanosleep", "int32(int32, int32, intp, intp)")


@jit
def monotonic_ns(timespec_address):
    """Now."""
    _clock_gettime(CLOCK_MONOTONIC, timespec_address)
    timespec = carray(address_pointer(timespec_address), 2, np.int64)
    return timespec[0] * SECOND_NS + timespec[1]


@jit
def sleep_until(wake_ns, timespec_address):
    """Sleep until `wake_ns` or a signal; returns the time after."""
    timespec = carray(address_pointer(timespec_address), 2, np.int64)
    timespec[0] = wake_ns // SECOND_NS
    timespec[1] = wake_ns % SECOND_NS
    _clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, timespec_address, 0)
    return monotonic_ns(timespec_address)


@jit
def sleep_for(duration_ns, timespec_address):
    """Sleep for `duration_ns` or until a signal."""
    timespec = carray(address_pointer(timespec_address), 2, np.int64)
    timespec[0] = duration_ns // SECOND_NS
    timespec[1] = duration_ns % SECOND_NS
    _clock_nanosleep(CLOCK_MONOTONIC, 0, timespec_address, 0)

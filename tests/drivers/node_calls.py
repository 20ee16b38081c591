"""Calls of a node's driver, compiled or, with NUMBA_DISABLE_JIT=1, as Python functions."""

from __future__ import annotations

import ctypes

from rtloop.drivers.base import Driver
from rtloop.drivers.contract import DriverCalls
from rtloop.foundation.native.compiled import UNCOMPILED
from rtloop.foundation.native.uncompiled import call


def open_calls(driver: Driver) -> DriverCalls:
    """Open a driver and return its calls."""
    pointers = driver.open()
    calls = DriverCalls(pointers, driver.facts)
    if UNCOMPILED:
        vars(calls).update(
            _read=lambda context, values: call(pointers.read, context, ctypes.addressof(values)),
            _write=lambda context, values: call(pointers.write, context, ctypes.addressof(values)),
        )
    return calls

"""The simplest driver and clock as C functions, with which the cost of the engine itself can be measured."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.drivers.base import Channel, Facts, Pointers
from rtloop.engine.clock import CONTEXT, Clock, clock_context, paced_now
from rtloop.foundation.native.compiled import cfunc
from rtloop.foundation.native.monotonic import monotonic_ns
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, carray

TAPE = np.dtype([("address", np.int64), ("count", np.int64), ("index", np.int64), ("written_v", np.float64)])


@cfunc(SIGNATURE)
def tape_read(context, values):
    """Give the next reading (V), age 0, and two observed signals of 0; the first reading follows the last."""
    tape = carray(context, 1, TAPE)[0]
    readings = carray(address_pointer(tape.address), tape.count, np.float64)
    out = carray(values, 4)
    out[0], out[1], out[2], out[3] = readings[tape.index], 0.0, 0.0, 0.0
    tape.index = tape.index + 1 if tape.index + 1 < tape.count else 0
    return 0


@cfunc(SIGNATURE)
def tape_write(context, values):
    """Store the drive (V) in the context."""
    carray(context, 1, TAPE)[0].written_v = carray(values, 1)[0]
    return 0


@cfunc(SIGNATURE)
def due_wait(context, timing):
    """Read the clock like the paced clock, but do not wait: every tick is due at once."""
    clock = carray(context, 1, CONTEXT)[0]
    out = carray(timing, 4)
    now_ns = monotonic_ns(clock.timespec_address)
    out[0] = out[1] = float(now_ns - clock.start_ns)
    out[2] = 0.0
    out[3] = float(now_ns)
    clock.index += 1
    return 0


class Tape:
    """A driver that plays an array of readings, with the facts of the simulated rig."""

    facts = Facts((Channel("adc0"),), (Channel("dac0"),), ("x_true_position_um", "x_hysteresis_um"), real=False)

    def __init__(self, readings_v: npt.NDArray[np.float64]) -> None:
        self._readings_v, self._context = readings_v, np.zeros(1, TAPE)
        self._context["address"], self._context["count"] = readings_v.ctypes.data, readings_v.size

    def pointers(self) -> Pointers:
        """Return the addresses of the compiled functions and of their context."""
        return Pointers(self._context.ctypes.data, tape_read.address, tape_write.address)


def due_clock(rate_hz: float) -> tuple[Clock, np.recarray[Any, Any]]:
    """Return a clock that is read as often as the paced clock but never waits, and its context, which must be kept."""
    context = clock_context(rate_hz)
    return Clock(due_wait.address, paced_now.address, context.ctypes.data), context

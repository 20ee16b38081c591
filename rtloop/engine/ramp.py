"""A ramp to safe outside the loop: before its first tick, after its last, and in place of a loop that died.

It begins where the outputs are, never moves one by more than the slew allows in a period, and takes its time from the
real interval between two writes.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from rtloop.drivers.base import Driver, Pointers, index_of
from rtloop.drivers.errors import DriverError

Volts = npt.NDArray[np.float64]
_WRITE = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)
SHORTEST_PERIOD_S = 0.0001
"""The ramp takes its steps at the loop's rate, like the loop's own, but no faster than an interpreter can."""
GIVE_UP_S = 1.0
"""As in the loop: a card that takes no write for so long is given up."""
SPIN_S = 0.0005
"""A sleep may last longer by so much: what is left of a period is spun."""


def safe_outputs_v(driver: Driver) -> Volts:
    """Safe value of every output, in the order of the facts."""
    return np.array([channel.safe_v for channel in driver.facts.outputs])


def output_indices(driver: Driver) -> list[int]:
    """Output of each axis, in the order of the axes."""
    return [index_of(driver.facts.outputs, wiring.output) for wiring in driver.wiring.values()]


def found_v(driver: Driver, noted_v: Sequence[float] | Volts | None) -> Volts:
    """Where the outputs of a driver are that was just opened: as it says, else as noted, axis by axis; else safe."""
    told = driver.outputs_v()
    if told is not None:
        return np.array(told, float)
    outputs_v = safe_outputs_v(driver)
    if noted_v is not None:
        outputs_v[output_indices(driver)] = noted_v
    return outputs_v


def ramp(from_v: Volts, safe_v: Volts, step_v: float) -> Iterator[Volts]:
    """Rows from `from_v` (exclusive) to `safe_v` (inclusive), no value moving by more than `step_v` a row."""
    now_v = from_v
    while not np.array_equal(now_v, safe_v):
        now_v = np.clip(safe_v, now_v - step_v, now_v + step_v)
        yield now_v


def ramp_to_safe(
    driver: Driver,
    pointers: Pointers,
    from_v: Volts,
    slew_v_per_s: float,
    on_step: Callable[[Volts], None] = lambda _: None,
) -> None:
    """Bring the outputs of an open driver from `from_v` to safe.

    A write that is refused is tried again each period: the output is where it was, and goes on from there. Raises
    DriverError for a card that takes no write for GIVE_UP_S.

    `on_step` is told what was written, after it was: whoever dies in between has noted where the outputs were a step
    before, and another ramp from there begins with the very same write.
    """
    write, period_s = _WRITE(pointers.write), max(1.0 / driver.rate_hz, SHORTEST_PERIOD_S)
    for row in ramp(from_v, safe_outputs_v(driver), slew_v_per_s * period_s):
        values = np.ascontiguousarray(row)
        given_up_s = time.monotonic() + GIVE_UP_S
        while (status := write(pointers.context, values.ctypes.data)) < 0 and time.monotonic() < given_up_s:
            _wait(time.monotonic() + period_s)
        if status < 0:
            raise DriverError(f"{driver.kind}: write failed while parking at {row.tolist()} V")
        on_step(row)
        _wait(time.monotonic() + period_s)


def _wait(until_s: float) -> None:
    while (left_s := until_s - time.monotonic()) > 0:
        if left_s > SPIN_S:
            time.sleep(left_s - SPIN_S)

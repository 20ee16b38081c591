"""Ramp of the outputs to safe, outside the loop: before its first tick, after its last, or after the loop died.

It begins at the present outputs, moves none by more than the slew rate allows in a period, and waits for the period
between two writes.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from rtloop.drivers.base import Channel, Driver, Pointers, channel_index
from rtloop.drivers.errors import DriverError
from rtloop.foundation.arrays import Real

_WRITE = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p)
SHORTEST_PERIOD_S, LONGEST_PERIOD_S = 0.0001, 0.01
"""Limits of the ramp's period, which is the loop's otherwise: an interpreter is not faster, and the steps of a slow
loop would be large."""
LONGEST_RAMP_S = 5.0
"""Maximum duration of a ramp to safe, from anywhere in the channel's range."""
GIVE_UP_S = 1.0
"""Time after which a card that refuses every write is given up, as in the loop."""
SPIN_S = 0.0005
"""Allowance for the delay of a sleep: the ramp spins for the last part of a period."""


def safe_outputs_v(driver: Driver) -> Real:
    """Return the safe value of every output (outputs,), in the order of the facts."""
    return np.array([channel.safe_v for channel in driver.facts.outputs])


def output_indices(driver: Driver) -> list[int]:
    """Return the index of each axis's output among the driver's outputs, in the order of the axes."""
    return [channel_index(driver.facts.outputs, wiring.output) for wiring in driver.wiring.values()]


def require_short_ramp(key: str, slew_v_per_s: float, output: Channel) -> None:
    """Raise ValueError, which begins with `key`, for a slew rate with which a ramp takes longer than LONGEST_RAMP_S.

    The ramp begins at the end of the channel's range that is farther from safe.
    """
    farthest_v = max(output.maximum_v - output.safe_v, output.safe_v - output.minimum_v)
    if slew_v_per_s * LONGEST_RAMP_S < farthest_v:
        ramp_s, minimum_v_per_s = farthest_v / slew_v_per_s, farthest_v / LONGEST_RAMP_S
        raise ValueError(
            f"{key}: {slew_v_per_s:g} V/s; the ramp of {farthest_v:g} V from the end of the channel's range to the "
            f"safe value takes {ramp_s:.3g} s; allowed: at most {LONGEST_RAMP_S:g} s, so at least "
            f"{minimum_v_per_s:g} V/s"
        )


def unusable_drives(driver: Driver, recorded_v: Sequence[float] | Real) -> list[str]:
    """Return a sentence for each axis whose recorded drive, in V, is NaN or beyond its channel's range; [] for none."""
    sentences = []
    for axis, index, volts in zip(driver.wiring, output_indices(driver), recorded_v, strict=True):
        channel = driver.facts.outputs[index]
        if not channel.minimum_v <= volts <= channel.maximum_v:
            allowed = f"{channel.minimum_v:g} … {channel.maximum_v:g} V"
            sentences.append(f"axis {axis}: the last recorded drive is {volts:g} V and is ignored; allowed: {allowed}")
    return sentences


def starting_outputs_v(driver: Driver, recorded_v: Sequence[float] | Real | None) -> Real:
    """Return the V at which a ramp begins for each output (outputs,) of an open driver: reported, else recorded, else
    the safe value.

    The values that the driver reports are limited to the channel's range; a reported NaN counts as safe. If the driver
    reports None, the drives `recorded_v`, one for each axis, are used; outputs without a recorded drive count as safe.
    So does a recorded drive that is NaN or beyond the range: a ramp from it could move the output away from safe.
    Raises DriverError if the outputs cannot be read.
    """
    safe_v = safe_outputs_v(driver)
    lowest_v, highest_v = np.array([(channel.minimum_v, channel.maximum_v) for channel in driver.facts.outputs]).T
    reported_v = driver.outputs_v()
    if reported_v is not None:
        outputs_v = np.clip(np.array(reported_v, float), lowest_v, highest_v)
        return np.where(np.isnan(outputs_v), safe_v, outputs_v)
    outputs_v = safe_v.copy()
    if recorded_v is not None:
        outputs_v[output_indices(driver)] = recorded_v
    return np.where((outputs_v >= lowest_v) & (outputs_v <= highest_v), outputs_v, safe_v)


def ramp(from_v: Real, safe_v: Real, step_v: float) -> Iterator[Real]:
    """Yield rows from `from_v` (exclusive) to `safe_v` (inclusive), both (outputs,) in V; none if they are equal.

    Each output moves by `step_v`, above 0, from row to row (by less in its last move), then stays at its safe value.
    """
    current_v = from_v
    while not np.array_equal(current_v, safe_v):
        current_v = np.clip(safe_v, current_v - step_v, current_v + step_v)
        yield current_v


def ramp_to_safe(
    driver: Driver,
    pointers: Pointers,
    from_v: Real,
    slew_v_per_s: float,
    on_step: Callable[[Real], None] = lambda _: None,
) -> None:
    """Ramp the outputs of an open driver from `from_v` (outputs,) to safe, in real time.

    A refused write is repeated each period. Raises DriverError for a card that refuses all writes for GIVE_UP_S.

    `on_step` receives each row after its write. If the process dies after a write and before this call, the caller has
    recorded the previous row, and another ramp from this row begins with the same write.
    """
    period_s = min(max(1.0 / driver.rate_hz, SHORTEST_PERIOD_S), LONGEST_PERIOD_S)
    write = _WRITE(pointers.write)
    for row in ramp(from_v, safe_outputs_v(driver), slew_v_per_s * period_s):
        values = np.ascontiguousarray(row)
        deadline_s = time.monotonic() + GIVE_UP_S
        while (status := write(pointers.context, values.ctypes.data)) < 0 and time.monotonic() < deadline_s:
            _wait_until(time.monotonic() + period_s)
        if status < 0:
            raise DriverError(
                f"driver {driver.kind!r}: the card refused to write {row.tolist()} V during the ramp to the safe "
                "values; the outputs may still carry voltage; check the amplifier"
            )
        on_step(row)
        _wait_until(time.monotonic() + period_s)


def _wait_until(until_s: float) -> None:
    """Sleep, then spin, until `until_s` of `time.monotonic`; return at once if it has passed."""
    while (remaining_s := until_s - time.monotonic()) > 0:
        if remaining_s > SPIN_S:
            time.sleep(remaining_s - SPIN_S)

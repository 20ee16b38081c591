"""A ramp to safe outside the loop: before its first tick, after its last, and in place of a loop that died.

It begins where the outputs are, never moves one by more than the slew allows in a period, and takes its time from the
real interval between two writes.
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
"""The ramp takes its steps at the loop's rate, like the loop's own, but no faster than an interpreter can. The steps of
a slow loop are divided: they would be large, and the last of them followed by a long wait."""
LONGEST_RAMP_S = 5.0
"""Of a trip, a stop or a parking, from anywhere in the channel's range to safe."""
GIVE_UP_S = 1.0
"""As in the loop: a card that takes no write for so long is given up."""
SPIN_S = 0.0005
"""A sleep may last longer by so much: what is left of a period is spun."""


def safe_outputs_v(driver: Driver) -> Real:
    """Safe value of every output, in the order of the facts."""
    return np.array([channel.safe_v for channel in driver.facts.outputs])


def output_indices(driver: Driver) -> list[int]:
    """Output of each axis, in the order of the axes."""
    return [channel_index(driver.facts.outputs, wiring.output) for wiring in driver.wiring.values()]


def require_short_ramp(key: str, slew_v_per_s: float, output: Channel) -> None:
    """Raise ValueError, which begins with `where`, for a slew that takes longer than LONGEST_RAMP_S to safe.

    The ramp counts from the end of the channel's range that is farthest from safe.
    """
    farthest_v = max(output.maximum_v - output.safe_v, output.safe_v - output.minimum_v)
    if slew_v_per_s * LONGEST_RAMP_S < farthest_v:
        ramp_s, minimum_v_per_s = farthest_v / slew_v_per_s, farthest_v / LONGEST_RAMP_S
        raise ValueError(
            f"{key}: {slew_v_per_s:g} takes {ramp_s:.3g} s from {farthest_v:g} V to "
            f"safe; {LONGEST_RAMP_S:g} s, so at least {minimum_v_per_s:g} V/s, are allowed"
        )


def unusable_drives(driver: Driver, recorded_v: Sequence[float] | Real) -> list[str]:
    """A sentence for each axis whose noted drive is no number, or beyond the range of its channel."""
    sentences = []
    for axis, index, volts in zip(driver.wiring, output_indices(driver), recorded_v, strict=True):
        channel = driver.facts.outputs[index]
        if not channel.minimum_v <= volts <= channel.maximum_v:
            allowed = f"{channel.minimum_v:g} … {channel.maximum_v:g} V"
            sentences.append(
                f"axis {axis}: the drive noted last is {volts:g} V, and counts for nothing; allowed: {allowed}"
            )
    return sentences


def starting_outputs_v(driver: Driver, recorded_v: Sequence[float] | Real | None) -> Real:
    """Where the outputs of a driver are that was just opened: as it says, else as noted, axis by axis; else safe.

    A card that says a value beyond a channel's range is at the end of that range. A noted value beyond it, or one that
    is no number, counts for nothing: a ramp from there could drive the output away from safe.
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
    """Rows from `from_v` (exclusive) to `safe_v` (inclusive), no value moving by more than `step_v` a row."""
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
    """Bring the outputs of an open driver from `from_v` to safe.

    A write that is refused is tried again each period: the output is where it was, and goes on from there. Raises
    DriverError for a card that takes no write for GIVE_UP_S.

    `on_step` is told what was written, after it was: whoever dies in between has noted where the outputs were a step
    before, and another ramp from there begins with the very same write.
    """
    period_s = min(max(1.0 / driver.rate_hz, SHORTEST_PERIOD_S), LONGEST_PERIOD_S)
    write = _WRITE(pointers.write)
    for row in ramp(from_v, safe_outputs_v(driver), slew_v_per_s * period_s):
        values = np.ascontiguousarray(row)
        deadline_s = time.monotonic() + GIVE_UP_S
        while (status := write(pointers.context, values.ctypes.data)) < 0 and time.monotonic() < deadline_s:
            _wait_until(time.monotonic() + period_s)
        if status < 0:
            raise DriverError(f"{driver.kind}: write failed while parking at {row.tolist()} V")
        on_step(row)
        _wait_until(time.monotonic() + period_s)


def _wait_until(until_s: float) -> None:
    while (remaining_s := until_s - time.monotonic()) > 0:
        if remaining_s > SPIN_S:
            time.sleep(remaining_s - SPIN_S)

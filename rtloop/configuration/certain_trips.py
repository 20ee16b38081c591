"""Trips that a reference causes by itself in closed loop: reversals that count as oscillation, and steps and sines that
leave a larger error, for longer, than the tracking interlock allows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from rtloop.analysis.closed_loop import Loop
from rtloop.analysis.step_response import step_response
from rtloop.configuration.axis import AxisOptions, InterlockOptions
from rtloop.configuration.checks import AxisCheck
from rtloop.foundation.arrays import Real
from rtloop.kernel.reference import Generator


def certain_trips(
    axis: AxisOptions, check: AxisCheck, values: Sequence[float], samples: Real, rate_hz: float, is_first: bool
) -> Iterator[str]:
    """Yield a line for each interlock that a reference trips: a generator's kind with its parameters, `values`, and its
    samples if it plays a table.

    The position follows as the loop on the model does; where this loop is not known, it equals the reference, and the
    error is not judged. With `is_first` the run begins with this reference, at the position 0.
    """
    interlocks, loop = axis.interlocks, check.on_model
    if loop is not None and (loop.reference_fault or not loop.is_stable):
        loop = None
    if interlocks.oscillation_swings > 0:
        yield from _oscillation(interlocks, loop, values, samples, rate_hz)
        if loop is not None and values[0] == Generator.TABLE:
            yield from _ringing(interlocks, loop, values, samples, rate_hz)
    if interlocks.tracking_ticks > 0 and loop is not None and loop.reference.settling_ticks == 1:
        bump_ticks = axis.limits.bump_s * rate_hz if is_first else 0.0
        error_um, ticks = _largest_error(interlocks, loop, values, samples, rate_hz, bump_ticks)
        if ticks >= interlocks.tracking_ticks:
            yield (
                f"its error of up to {error_um:.4g} µm stays beyond interlocks.tracking_error_um = "
                f"{interlocks.tracking_error_um:g} for interlocks.tracking_ticks = {interlocks.tracking_ticks} ticks; "
                "the loop would trip. Increase one of the two, or move the reference more slowly"
            )


def _oscillation(
    interlocks: InterlockOptions, loop: Loop | None, values: Sequence[float], samples: Real, rate_hz: float
) -> Iterator[str]:
    """Yield a line if the position turns back by more than `oscillation_um` so often that the interlock trips."""
    ways_um, ticks, is_endless = _reversals(values, samples, rate_hz)
    if loop is not None and ticks.size:
        ways_um = ways_um * np.abs(loop.response_from_reference(rate_hz / (2 * ticks))[0])
    is_swing = _are_swings(interlocks, ways_um, ticks)
    longest = np.diff(np.flatnonzero(np.concatenate([[True], ~is_swing, [True]]))).max() - 1
    if longest >= interlocks.oscillation_swings or (is_endless and ticks.size and is_swing.all()):
        largest_um, most_ticks = ways_um[is_swing].max(), math.ceil(ticks[is_swing].max())
        yield (
            f"turns back by {largest_um:.4g} µm within {most_ticks} ticks, beyond interlocks.oscillation_um = "
            f"{interlocks.oscillation_um:g} within interlocks.swing_ticks = {interlocks.swing_ticks}, for "
            f"interlocks.oscillation_swings = {interlocks.oscillation_swings} times; the loop would trip. Use an "
            f"oscillation_um above {largest_um:.4g}, or swing_ticks below {most_ticks}"
        )


def _ringing(
    interlocks: InterlockOptions, loop: Loop, values: Sequence[float], samples: Real, rate_hz: float
) -> Iterator[str]:
    """Yield a line if the loop rings after the largest step of a table so long that the interlock trips."""
    step_um = _largest_step_um(values, samples)
    most_ticks = min(int(values[3]), interlocks.oscillation_swings * interlocks.swing_ticks)
    if step_um <= interlocks.oscillation_um or most_ticks < 3:
        return
    response = step_response(loop, most_ticks / rate_hz)
    moves = np.sign(np.diff(response.position))
    turns = np.flatnonzero(moves[1:] * moves[:-1] < 0) + 1
    ways_um, ticks = step_um * np.abs(np.diff(response.position[turns])), rate_hz * np.diff(response.time_s[turns])
    is_swing = _are_swings(interlocks, ways_um, ticks)
    if is_swing[: interlocks.oscillation_swings].sum() == interlocks.oscillation_swings:
        yield (
            f"a step of {step_um:.4g} µm rings: the position turns back by more than interlocks.oscillation_um = "
            f"{interlocks.oscillation_um:g} for interlocks.oscillation_swings = {interlocks.oscillation_swings} times; "
            "the loop would trip. Damp the loop, or use smaller steps"
        )


def _are_swings(interlocks: InterlockOptions, ways_um: Real, ticks: Real) -> npt.NDArray[np.bool_]:
    """Return whether ways between reversals (n,), which last some `ticks` each, count as swings of the interlock."""
    return (ways_um > interlocks.oscillation_um) & (ticks <= interlocks.swing_ticks)


def _largest_step_um(values: Sequence[float], samples: Real) -> float:
    """Return the largest step of a table, of one that repeats also from its end to its begin."""
    played_um = np.append(samples, samples[:1])[: None if values[4] else -1]
    return float(np.max(np.abs(np.diff(played_um)), initial=0.0))


def _reversals(values: Sequence[float], samples: Real, rate_hz: float) -> tuple[Real, Real, bool]:
    """Return the ways in µm between reversals of a reference (n,), their durations in ticks (n,), and whether they
    repeat for ever; none for a sweep, an input channel and a constant.
    """
    if values[0] in (Generator.SINE, Generator.TRIANGLE):
        return np.array([2 * abs(values[1])]), np.array([rate_hz / (2 * values[2])]), True
    if values[0] != Generator.TABLE:
        return np.empty(0), np.empty(0), False
    repeats = values[4] != 0.0
    played = np.tile(samples, 2) if repeats else samples
    moves = np.diff(played)
    moving: npt.NDArray[np.intp] = np.flatnonzero(moves)
    turns = moving[1:][np.diff(np.sign(moves[moving])) != 0]
    ends = np.append(turns, moving[-1:] + 1)  # the last way ends where the reference stops
    return np.abs(np.diff(played[ends])), np.diff(ends) * values[3], repeats


def _largest_error(
    interlocks: InterlockOptions, loop: Loop, values: Sequence[float], samples: Real, rate_hz: float, bump_ticks: float
) -> tuple[float, int]:
    """Return the largest error in µm of a sine, after a step of a table, or from 0 to a constant or a first sample, and
    the ticks for which it stays beyond the tracking interlock, `tracking_ticks` at most; zeros for other references.

    `bump_ticks` is the time constant of the error that an entry leaves, 0 without an entry.
    """
    limit_um, most_ticks = interlocks.tracking_error_um, interlocks.tracking_ticks
    if values[0] == Generator.SINE:
        error_um = abs(values[1] * (1 - loop.response_from_reference(values[2])[0][0]))
        share = math.asin(min(limit_um / error_um, 1.0)) / math.pi if error_um else 0.5
        return error_um, math.floor((0.5 - share) * rate_hz / values[2])
    if values[0] not in (Generator.HOLD, Generator.TABLE) or (values[0] == Generator.TABLE and values[3] < most_ticks):
        return 0.0, 0
    levels_um = samples if values[0] == Generator.TABLE else np.array(values[1:2])
    if bump_ticks and abs(levels_um[0]) * math.exp(-most_ticks / bump_ticks) > limit_um:
        return abs(levels_um[0]), most_ticks
    step_um = _largest_step_um(values, levels_um)
    if step_um <= limit_um:
        return 0.0, 0
    errors_um = step_um * np.abs(1 - step_response(loop, (most_ticks - 1) / rate_hz).position)
    return step_um, most_ticks if errors_um.min() > limit_um else 0

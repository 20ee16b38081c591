"""Levels that an input holds, corrected by the position that settles at each of them.

    p_l = a + g u_l + e_l,     u_l ← u_l + e_l/g          least squares over the levels, each by its duration

The input of D(s) comes from a model of the hysteresis, which errs by a constant at each level. A fit takes such errors
for noise and colours its noise model with them, which moves the fast real poles by a standard deviation, or it takes
them for modes. The position at rest measures the levels to within the noise of a mean. Two levels leave no e_l: only a
recording with three or more is corrected. Where the position does not settle at each to within its noise, the levels
are fitted together with the modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rtloop.design.identification.axis_recording import noise_std
from rtloop.design.identification.dynamics.identify_delay import delay_input
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.prediction_error import (
    LEAST_IMPROVEMENT,
    MOST_LEVELS,
    Excitation,
    has_stable_continuous_form,
    minimise_with_levels,
)
from rtloop.foundation.arrays import Real

SHORTEST_TAIL = 50
"""Least number of samples in a mean of the settled position."""
RESTLESS = 1.2
"""Standard deviation of a position over its noise, above which the position still rings, drifts or creeps."""
APART = 4.0
"""Standard errors by which the two halves of a settled position may differ."""


class CorrectedLevels(NamedTuple):
    """The recording with its levels corrected, and the largest correction, in the input's unit."""

    run: Excitation
    largest: float


def correct_levels(run: Excitation) -> CorrectedLevels:
    """Return the recording with the levels of its input corrected by the settled positions; the first level stays.

    A correction is the distance of the settled position from the line fitted to all of them, divided by the line's
    slope, less the same value of the first level. The recording is unchanged, with a correction of 0, if its input
    holds fewer than three levels or one for less than 2 · SHORTEST_TAIL samples, and if the position does not settle at
    each.
    """
    changes = np.flatnonzero(np.diff(run.input)) + 1
    holds = [slice(*ends) for ends in pairwise([0, *changes.tolist(), run.input.size])]
    unchanged = CorrectedLevels(run, 0.0)
    if len(holds) < 3 or min(hold.stop - hold.start for hold in holds) < 2 * SHORTEST_TAIL:
        return unchanged
    tails = [run.position_um[(hold.start + hold.stop) // 2 : hold.stop] for hold in holds]
    noise_um = noise_std(run.position_um)
    if not all(_is_settled(tail, noise_um) for tail in tails):
        return unchanged
    durations = np.array([hold.stop - hold.start for hold in holds])
    levels = run.input[[hold.start for hold in holds]]
    gain, offset_um = np.polyfit(levels, [tail.mean() for tail in tails], 1, w=np.sqrt(durations))
    measured = np.array([(tail.mean() - offset_um) / gain for tail in tails])
    corrected = measured - measured[0] + levels[0]
    return CorrectedLevels(replace(run, input=np.repeat(corrected, durations)), float(np.abs(corrected - levels).max()))


def fit_levels(run: Excitation, models: Sequence[Innovations], delay_ticks: int) -> CorrectedLevels:
    """Return the recording with the levels of its input after the second one as the position shows them.

    The levels are fitted together with each of `models`, from its modes on, behind `delay_ticks` samples of delay; they
    are taken from the fit of fewest poles that predicts as well as the best one. The recording is unchanged, with a
    correction of 0, if its input holds fewer than three levels or more than MOST_LEVELS, and if no fit has modes that
    decay and a continuous form.
    """
    changes = np.flatnonzero(np.diff(run.input)) + 1
    if not 2 <= changes.size <= MOST_LEVELS:
        return CorrectedLevels(run, 0.0)
    ticks, delayed_run = np.arange(run.input.size), delay_input(run, delay_ticks)
    fits: list[tuple[int, float, Real]] = []
    for model in models:
        steps = (ticks - delay_ticks >= changes[1:, None]).astype(float)
        fitted, sizes = minimise_with_levels(model, delayed_run, steps, noise=True)
        errors = fitted.errors(delayed_run.input + sizes @ steps, run.position_um)
        if errors is not None and has_stable_continuous_form(fitted):
            fits.append((model.order, float(np.sqrt(np.mean(errors**2))), sizes))
    if not fits:
        return CorrectedLevels(run, 0.0)
    limit_um = (1 + LEAST_IMPROVEMENT) * min(rms_um for _, rms_um, _ in fits)
    _, _, sizes = min((fit for fit in fits if fit[1] <= limit_um), key=lambda fit: fit[0])
    corrections = sizes @ (ticks >= changes[1:, None])
    return CorrectedLevels(replace(run, input=run.input + corrections), float(np.abs(corrections).max()))


def _is_settled(tail: Real, noise_um: float) -> bool:
    """Whether a position (samples,) neither drifts nor rings beyond its noise, by RESTLESS and APART."""
    first, second = np.array_split(tail, 2)
    bound_um = APART * noise_um * np.sqrt(1 / first.size + 1 / second.size)
    return bool(tail.std() <= RESTLESS * noise_um and abs(first.mean() - second.mean()) <= bound_um)

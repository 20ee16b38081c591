"""Whole samples of delay between input and position, beyond the one that a held output takes.

    y_k = Σ a_i y_k−i + Σ b_i u_k−i + constant,     b_1 … b_d = 0      a delay of d samples           ARX

A delay that is left out of a model comes back as real poles near the sampling rate. So models are fitted behind each
delay that a long ARX model leaves possible, to the first part of the recording, and the delay is that of the model
which predicts the rest best; among equals, of the one with the fewest poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtloop.design.identification.dynamics.markov import ARX_ORDER, lagged
from rtloop.design.identification.dynamics.prediction_error import WORTH, Excitation, model_at_gap
from rtloop.hil.modal import Real

MOST_TICKS = 5
LEAST_SHARE = 0.25
"""Of all changes of the input, squared, that each part of a recording must hold to fit by, or to judge by."""
NEEDED = 30.0
"""A first coefficient without which the sum of squared errors grows by so many variances is there."""


def delayed(run: Excitation, ticks: int) -> Excitation:
    """The recording with its input `ticks` samples later; at rest before it."""
    return replace(run, input=np.concatenate([np.zeros(ticks), run.input[: run.input.size - ticks]]))


def identified_delay(run: Excitation, orders: Sequence[int]) -> int:
    """Samples of delay, 0 to MOST_TICKS; without a second part to judge by, as the fit itself tells."""
    possible = _possible(run)
    if len(possible) == 1:
        return possible[0]
    start = held_out_from(run)
    found: list[tuple[float, int, int]] = []
    for ticks in possible:
        late = delayed(run, ticks)
        model = model_at_gap(first_part(late, start), orders)
        errors = model and model.errors(late.input, late.position_um)
        if model is not None and errors is not None:
            found.append((float(np.sqrt(np.mean(errors[start or 0 :] ** 2))), model.order, ticks))
    limit = min((rms for rms, _, _ in found), default=0.0) * (1 + WORTH)
    return min(((order, ticks) for rms, order, ticks in found if rms <= limit), default=(0, possible[-1]))[1]


def first_part(run: Excitation, start: int | None) -> Excitation:
    """Everything before the part to judge by."""
    return replace(run, input=run.input[:start], position_um=run.position_um[:start])


def held_out_from(run: Excitation) -> int | None:
    """The first sample of the part to judge by; None where the changes of the input cannot be parted in two.

    It begins with the first change that has half of all changes before it, or else at least LEAST_SHARE of them.
    """
    changes = np.diff(run.input, prepend=0.0) ** 2
    before = (np.cumsum(changes) - changes) / max(float(changes.sum()), 1e-300)
    for share in (0.5, LEAST_SHARE):
        enough = np.flatnonzero((changes > 0) & (before >= share))
        if enough.size and before[enough[0]] <= 1 - LEAST_SHARE:
            return int(enough[0])
    return None


def _possible(run: Excitation) -> Sequence[int]:
    """0 to the first delay that leaves out a coefficient which is there."""
    regressors = np.vstack([*lagged((run.position_um, run.input), ARX_ORDER), np.ones(run.input.size)])
    errors = [
        _squared_error(np.delete(regressors, range(ARX_ORDER, ARX_ORDER + ticks), axis=0), run.position_um)
        for ticks in range(MOST_TICKS + 1)
    ]
    limit = errors[0] * (1 + NEEDED / run.input.size)
    return [ticks for ticks in range(MOST_TICKS + 1) if errors[ticks] <= limit]


def _squared_error(regressors: Real, position_um: Real) -> float:
    solution, *_ = np.linalg.lstsq(regressors.T, position_um, rcond=1e-12)
    return float(np.sum((position_um - solution @ regressors) ** 2))

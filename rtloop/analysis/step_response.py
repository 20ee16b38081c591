"""Step response of a loop, and its figures for a specification.

Exact: in discrete time the plant's input is constant for a period, within which `POINTS` positions are known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import Loop
from rtloop.foundation.arrays import Real
from rtloop.linear.matrices import matrix_exponential

SETTLING_BAND = 0.05
SAMPLE_COUNT = 1 << 16
"""Samples of a response; the first 1/64 of continuous time is sampled 64 times as densely once more."""


class StepResponse(NamedTuple):
    """Response to a unit step of the reference at 0 s: `time_s`, `position` x, `command` v, each (k,).

    In discrete time each period has `POINTS` entries, or one where only the samples are known; the command is constant
    over a period.
    """

    time_s: Real
    position: Real
    command: Real


class StepMetrics(NamedTuple):
    """Figures of a unit step: time to settle within 5 % of the final value, overshoot over it in percent, its distance
    from 1 in percent, the largest |v|, and x at given times.

    Settling time and overshoot are NaN where the final value is further than 5 % from the reference: a loop that does
    not follow has neither.
    """

    settling_time_s: float
    overshoot_percent: float
    static_error_percent: float
    peak_command: float
    position_at: tuple[float, ...]


def step_response(loop: Loop, duration_s: float | None = None) -> StepResponse:
    """Return the response to a unit step of the reference, from rest, for `duration_s`.

    The default duration is ten times 1/|Re s| of the slowest closed-loop pole, or 1 s without poles and for a pole on
    the imaginary axis; in discrete time plus the pre-filter's settling. A discrete response ends after SAMPLE_COUNT
    ticks at the latest.
    """
    if loop.period_s is not None:
        return _discrete_response(loop, loop.period_s, duration_s)
    duration_s = duration_s or _response_duration_s(loop)
    fine, coarse = (
        _continuous_response(loop, duration_s / SAMPLE_COUNT / 64),
        _continuous_response(loop, duration_s / SAMPLE_COUNT),
    )
    is_later = coarse.time_s > fine.time_s[-1]
    return StepResponse(*(np.concatenate([early, late[is_later]]) for early, late in zip(fine, coarse, strict=True)))


def step_metrics(loop: Loop, times_s: Sequence[float]) -> StepMetrics:
    """Return the figures of a unit step of the reference, between ticks as well as at them, with the position at
    `times_s`.

    All are NaN for an unstable loop and for a law that is not linear in its reference, settling time and overshoot also
    if the final position is further than 5 % from 1.
    """
    if not loop.is_stable or loop.reference_fault:
        return StepMetrics(math.nan, math.nan, math.nan, math.nan, tuple(math.nan for _ in times_s))
    response = step_response(loop)
    final, command = loop.final_values
    follows = abs(1 - final) <= SETTLING_BAND
    return StepMetrics(
        _settling_time_s(response, final) if follows else math.nan,
        100 * max(0.0, float(np.max(response.position / final)) - 1) if follows else math.nan,
        100 * abs(1 - final),
        float(np.max(np.abs(response.command), initial=abs(command))),
        tuple(position_after_step(loop, t) for t in times_s),
    )


def position_after_step(loop: Loop, time_s: float) -> float:
    """Return the position x at `time_s` after a unit step of the reference; for a discrete loop at the last known point
    up to it.
    """
    if loop.period_s is None:
        a, b, c, _ = loop.matrices
        return float(c[0] @ matrix_exponential(_joint_matrix(a, b, 0.0) * time_s)[:-1, -1])
    response = step_response(loop, time_s + loop.period_s)
    return float(response.position[np.flatnonzero(response.time_s <= time_s + 1e-9 * loop.period_s)[-1]])


def _settling_time_s(response: StepResponse, final: float) -> float:
    """Return the time in s of the last entry into the band of ±5 %, by a straight line between samples; 0 if never
    outside, NaN if it ends outside.
    """
    excess = np.abs(response.position - final) - SETTLING_BAND * abs(final)
    last = np.flatnonzero(excess > 0)
    if not last.size:
        return 0.0
    i = int(last[-1])
    if i + 1 == excess.size:
        return math.nan
    part = excess[i] / (excess[i] - excess[i + 1])
    return float(response.time_s[i] + part * (response.time_s[i + 1] - response.time_s[i]))


def _continuous_response(loop: Loop, interval_s: float) -> StepResponse:
    """Return SAMPLE_COUNT samples of the step response from rest, `interval_s` apart."""
    a, b, c, d = loop.matrices
    states = _state_sequence(matrix_exponential(_joint_matrix(a, b, 0.0) * interval_s), SAMPLE_COUNT)
    position, command = c @ states + d[:, None]
    return StepResponse(interval_s * np.arange(SAMPLE_COUNT, dtype=float), position, command)


def _discrete_response(loop: Loop, period_s: float, duration_s: float | None) -> StepResponse:
    """Return the step response from rest for `duration_s`; None: for the default duration of `step_response`.

    The responses to steps of error and command are filtered by the pre-filter and summed.
    """
    a, b, c, d = loop.matrices
    reference, (rows, direct), injection = loop.reference, loop.positions, loop.injection
    duration_s = duration_s or _response_duration_s(loop) + reference.settling_ticks * period_s
    count = min(math.ceil(duration_s / period_s) + 1, SAMPLE_COUNT)
    states = _unit_step_states(a, b, count)
    position = reference.error_input(rows @ states + direct[:, None])
    command = reference.error_input(c[1] @ states + d[1])
    if reference.has_command_path:
        states = _unit_step_states(a, injection.b, count)
        position += reference.command_input(rows @ states + injection.between[:, None])
        command += reference.command_input(c[1] @ states + 1.0)
    points = rows.shape[0]
    time_s = period_s / points * np.arange(count * points, dtype=float)
    return StepResponse(time_s, position.T.ravel(), np.repeat(command, points))


def _unit_step_states(a: Real, b: Real, count: int) -> Real:
    """Return states (n, count) of a discrete system from rest with input 1."""
    return _state_sequence(_joint_matrix(a, b, 1.0), count)


def _joint_matrix(a: Real, b: Real, corner: float) -> Real:
    """Return [[a, b], [0, corner]], the matrix of states and a constant input; `corner` is 0 for rates, 1 for
    samples.
    """
    return np.block([[a, b[:, None]], [np.zeros(b.size), corner]])


def _state_sequence(power: Real, count: int) -> Real:
    """Return the states (n − 1, count) of z⁺ = `power` z from the last unit vector, without the last row, which is 1.

    The powers of the matrix are squared from block to block, so that blocks double in length.
    """
    states = np.eye(power.shape[0])[:, -1:]
    while states.shape[1] < count:
        states = np.hstack([states, power @ states])
        power = power @ power
    return states[:-1, :count]


def _response_duration_s(loop: Loop) -> float:
    """Return the duration of a step response in s: ten time constants 1/|Re s| of the slowest closed-loop pole.

    1 s without poles and for a pole on the imaginary axis.
    """
    slowest = float(np.min(np.abs(loop.rates.real), initial=math.inf))
    return 10 / slowest if 0 < slowest < math.inf else 1.0

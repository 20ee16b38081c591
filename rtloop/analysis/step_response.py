"""Step response of a loop, exact at its samples, and what a specification asks of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from rtloop.analysis.closed_loop import Loop
from rtloop.hil.modal import Real

COUNT = 1 << 16
"""Samples of a response; the first 1/64 of continuous time is sampled 64 times as densely once more."""


class StepResponse(NamedTuple):
    """Answer to a unit step of the reference at 0 s: `time_s`, `position` x, `command` v, each (k,)."""

    time_s: Real
    position: Real
    command: Real


class StepMetrics(NamedTuple):
    """Settling to within 5 % of the final value, overshoot over it, largest |v|, x at the times asked for."""

    settling_time_s: float
    overshoot_percent: float
    peak_command: float
    position_at: tuple[float, ...]


def step_response(loop: Loop, duration_s: float | None = None) -> StepResponse:
    """Samples until the slowest closed-loop pole has died away, or `duration_s`; ticks if the loop is discrete."""
    duration_s = duration_s or _duration(loop)
    if loop.period_s is not None:
        return _sampled(loop, loop.period_s, min(math.ceil(duration_s / loop.period_s) + 1, COUNT))
    fine, coarse = _sampled(loop, duration_s / COUNT / 64, COUNT), _sampled(loop, duration_s / COUNT, COUNT)
    later = coarse.time_s > fine.time_s[-1]
    return StepResponse(*(np.concatenate([early, late[later]]) for early, late in zip(fine, coarse, strict=True)))


def step_metrics(loop: Loop, times_s: Sequence[float]) -> StepMetrics:
    """Of a stable loop; NaN throughout for an unstable one. A discrete loop is judged at its ticks, not between."""
    if not loop.is_stable:
        return StepMetrics(math.nan, math.nan, math.nan, tuple(math.nan for _ in times_s))
    response = step_response(loop)
    final = 1.0 if math.isinf(loop.static_gain) else loop.static_gain / (1 + loop.static_gain)
    overshoot = 100 * max(0.0, float(np.max(response.position / final)) - 1) if final else math.nan
    at = tuple(position_at(loop, t) for t in times_s)
    return StepMetrics(_settling(response, final), overshoot, float(np.max(np.abs(response.command))), at)


def position_at(loop: Loop, time_s: float) -> float:
    """x at one time after a unit step; at the last tick before it if the loop is discrete."""
    joint = _joint(loop, time_s if loop.period_s is None else loop.period_s)
    if loop.period_s is not None:
        joint = np.linalg.matrix_power(joint, math.floor(time_s / loop.period_s + 1e-9))
    _, _, c, _ = loop.matrices
    return float(c[0] @ joint[:-1, -1])


def _settling(response: StepResponse, final: float) -> float:
    """Where the response enters the band of ±5 % for the last time, between samples by a straight line."""
    outside = np.abs(response.position - final) - 0.05 * abs(final)
    last = np.flatnonzero(outside > 0)
    if not last.size:
        return 0.0
    i = int(last[-1])
    if i + 1 == outside.size:
        return math.nan
    part = outside[i] / (outside[i] - outside[i + 1])
    return float(response.time_s[i] + part * (response.time_s[i + 1] - response.time_s[i]))


def _joint(loop: Loop, interval_s: float) -> Real:
    """The closed loop with its constant reference as one more state, advanced by one interval (n + 1, n + 1)."""
    a, b, _, _ = loop.matrices
    n = b.size
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n], joint[:n, n] = a, b
    if loop.period_s is None:
        return np.asarray(expm(joint * interval_s), dtype=float)
    joint[n, n] = 1.0
    return joint


def _sampled(loop: Loop, interval_s: float, count: int) -> StepResponse:
    """`count` samples from rest: blocks of states that double, [X, Aᵏ X], rather than a loop over samples."""
    _, _, c, d = loop.matrices
    power = _joint(loop, interval_s)
    states = np.eye(power.shape[0])[:, -1:]
    while states.shape[1] < count:
        states = np.hstack([states, power @ states])
        power = power @ power
    states = states[:, :count]
    position, command = c @ states[:-1] + d[:, None]
    return StepResponse(interval_s * np.arange(count, dtype=float), position, command)


def _duration(loop: Loop) -> float:
    """Ten time constants of the slowest closed-loop pole; 1 s where none is defined."""
    slowest = float(np.min(np.abs(loop.rates.real), initial=math.inf))
    return 10 / slowest if 0 < slowest < math.inf else 1.0

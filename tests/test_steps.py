"""The step figures of a run, against the closed form of a second-order system; up, down, from and to anywhere.

x(t) = 1 − e^{−ζωt} (cos ω_d t + ζ/√(1 − ζ²) sin ω_d t),   overshoot e^{−πζ/√(1 − ζ²)} at π/ω_d
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from rtloop.recording.views.steps import step_metrics

RATE_HZ, OMEGA = 10_000.0, 2 * np.pi * 80.0
DWELL = 4000


def answer(time_s: np.ndarray | float, zeta: float) -> np.ndarray:
    damped = np.sqrt(1 - zeta**2)
    turn = OMEGA * damped * np.asarray(time_s)
    return 1 - np.exp(-zeta * OMEGA * np.asarray(time_s)) * (np.cos(turn) + zeta / damped * np.sin(turn))


def settled_s(zeta: float, band: float = 0.05) -> float:
    """Return the last time in s at which |x − 1| is `band`, between the last extreme beyond it and the next one."""
    half_turn_s = np.pi / (OMEGA * np.sqrt(1 - zeta**2))
    extremes = half_turn_s * np.arange(0, 200)
    beyond = np.flatnonzero(np.abs(answer(extremes, zeta) - 1) > band)[-1]
    return brentq(lambda t: abs(float(answer(t, zeta)) - 1) - band, extremes[beyond], extremes[beyond + 1])


@pytest.mark.parametrize("zeta", [0.1, 0.4, 0.8])
@pytest.mark.parametrize(("before", "after"), [(0.0, 20.0), (20.0, 0.0), (-5.0, -25.0), (-25.0, 3.0)])
def test_a_second_order_step(zeta: float, before: float, after: float) -> None:
    reference = np.repeat([before, after], [500, DWELL])
    x = answer(np.arange(DWELL) / RATE_HZ, zeta)
    position = np.concatenate([np.full(500, before), before + (after - before) * x])
    metrics = step_metrics(reference, position, RATE_HZ)
    assert metrics.steps == 1
    assert metrics.overshoot_percent == pytest.approx(100 * np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), abs=0.2)
    assert metrics.settling_time_ms == pytest.approx(1e3 * settled_s(zeta), abs=1e3 / RATE_HZ + 1e-6)
    assert metrics.static_error_percent == pytest.approx(0.0, abs=1e-3)


def test_an_answer_from_below_has_no_overshoot() -> None:
    """Upwards and downwards; the mean of the last fifth is the final value, whose distance is the static error."""
    for height in (10.0, -10.0):
        reference = np.repeat([0.0, height], [10, DWELL])
        position = np.concatenate([np.zeros(10), 0.98 * height * (1 - np.exp(-np.arange(DWELL) / 100))])
        metrics = step_metrics(reference, position, RATE_HZ)
        assert metrics.overshoot_percent == pytest.approx(0.0, abs=1e-6)
        assert metrics.static_error_percent == pytest.approx(2.0, abs=1e-3)
        assert metrics.settling_time_ms == pytest.approx(10.0 * np.log(0.98 / 0.05), abs=0.1)


def test_middle_and_worst_of_several() -> None:
    levels = [10.0, 0.0, 10.0]
    reference = np.repeat([0.0, *levels], [10, DWELL, DWELL, DWELL])
    parts, before = [np.zeros(10)], 0.0
    for level, zeta in zip(levels, (0.2, 0.4, 0.6), strict=True):
        parts.append(before + (level - before) * answer(np.arange(DWELL) / RATE_HZ, zeta))
        before = level
    metrics = step_metrics(reference, np.concatenate(parts), RATE_HZ)
    percents = [100 * np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)) for zeta in (0.2, 0.4, 0.6)]
    assert metrics.steps == 3
    assert metrics.overshoot_percent == pytest.approx(percents[1], abs=0.2)
    assert metrics.overshoot_percent_worst == pytest.approx(percents[0], abs=0.2)


@pytest.mark.parametrize(
    "position",
    [np.zeros(DWELL), np.full(DWELL, -20.0), np.full(DWELL, 18.9)],
    ids=["still", "wrong way", "5.5 % short"],
)
def test_a_step_that_ends_away_from_its_reference_has_no_settling_time_and_no_overshoot(position: np.ndarray) -> None:
    reference = np.repeat([0.0, 20.0], [10, DWELL])
    metrics = step_metrics(reference, np.concatenate([np.zeros(10), position]), RATE_HZ)
    assert (metrics.steps, metrics.unreached) == (1, 1)
    assert np.isinf(metrics.settling_time_ms)
    assert np.isnan(metrics.overshoot_percent)
    assert metrics.static_error_percent == pytest.approx(100 * abs(position[-1] - 20.0) / 20.0)
    values = metrics.as_dict()
    assert values["settling_time_ms"] is None
    assert values["overshoot_percent_worst"] is None


def test_one_step_of_three_that_is_not_reached_counts_as_the_worst() -> None:
    reference = np.repeat([0.0, 10.0, 0.0, 10.0], [10, DWELL, DWELL, DWELL])
    position = np.where(np.arange(reference.size) < 10 + 2 * DWELL, reference, 0.0)
    metrics = step_metrics(reference, position, RATE_HZ)
    assert (metrics.steps, metrics.unreached) == (3, 1)
    assert metrics.settling_time_ms == 0.0
    assert np.isinf(metrics.settling_time_ms_worst)


def test_a_reference_without_steps_has_no_figures() -> None:
    assert step_metrics(np.zeros(100), np.zeros(100), RATE_HZ) is None
    assert step_metrics(np.repeat([0.0, 1.0], [95, 5]), np.zeros(100), RATE_HZ) is None
    wave = np.sin(np.arange(20_000.0))
    assert step_metrics(wave, wave, RATE_HZ) is None


@pytest.mark.parametrize("before", [0.0, 9.0], ids=["still", "moves back by 9 of 20 µm"])
def test_a_step_to_a_position_never_left_is_unreached(before: float) -> None:
    reference = np.repeat([20.0, 0.0], [10, DWELL])
    metrics = step_metrics(reference, np.repeat([before, 0.0], [10, DWELL]), RATE_HZ)
    assert (metrics.steps, metrics.unreached) == (1, 1)
    assert np.isinf(metrics.settling_time_ms)
    assert np.isnan(metrics.overshoot_percent)
    assert metrics.static_error_percent == pytest.approx(100 * (1 - before / 20.0))

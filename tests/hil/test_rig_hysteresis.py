"""Hysteresis against max/min written out here, and against the paper's eq (4)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from rtloop.hil.options import BoucWenOptions, DynamicsOptions, HysteresisOptions
from rtloop.hil.stages.hysteresis import play_output

# Eq (4): thresholds r_i [V] and weights p_i [µm/V].
R = np.array([0.095, 0.38, 0.84, 1.46, 2.21, 3.07, 4.01, 4.98, 5.96, 6.89, 7.76, 8.52, 9.14, 9.61, 9.9])
P = np.array([2.55, 0.57, 1.3, -1.57, 1.25, -0.054, -0.032, 0.66, 0.16, -0.77, 2.02, -1.63, -0.15, 2.99, -1.09])
RIGID = DynamicsOptions(form="zpk", gain=1.0)

volts = st.floats(-20, 20)
thresholds = st.floats(0, 10)


def model_output(drive: np.ndarray, weights: np.ndarray, thresholds: np.ndarray = R) -> np.ndarray:
    """Return Σ p_i F_{r_i}[u] from rest, F as in the text under eq (1): max(u − r, min(u + r, F₋))."""
    plays, out = np.zeros(thresholds.size), []
    for u in drive:
        plays = np.maximum(u - thresholds, np.minimum(u + thresholds, plays))
        out.append(weights @ plays)
    return np.array(out)


def inverse_of_eq_4(command: np.ndarray) -> np.ndarray:
    """Return Kuhnen's inverse (2003) of eq (4), r_0 taken as 0: z_j = Σ_{i<=j} p_i (r_j − r_i), g by partial sums."""
    sums = np.cumsum(P)
    z = np.array([P[: j + 1] @ (R[j] - R[: j + 1]) for j in range(R.size)])
    g = np.array([1 / P[0], *(-P[1:] / (sums[1:] * sums[:-1]))])
    return model_output(command, g, z)


def height_percent(drive: np.ndarray, output: np.ndarray) -> float:
    """Return 100·h/H, largest opening over total height, of the last closed loop of `periods`, from the minimum on."""
    x, y = drive[3000:7001], output[3000:7001]
    half = x.size // 2
    up, down = y[: half + 1], y[half:][::-1]
    opening = np.abs(np.interp(x[: half + 1], x[half:][::-1], down) - up).max()
    return 100 * float(opening / (y.max() - y.min()))


def periods(amplitude: float) -> np.ndarray:
    """Return three periods of a sine, from 0, 4000 points each."""
    return amplitude * np.sin(2 * np.pi * np.arange(12001) / 4000)


def displacement(run, ideal, truth: str, drive: np.ndarray, **options) -> np.ndarray:
    """Return y (µm) of the rig for each drive (V), without the period of delay."""
    options = ideal(hysteresis=HysteresisOptions(truth=truth, **options), dynamics=RIGID)
    return run(np.append(drive, 0.0), options).hysteresis_um[1:]


def test_initial_curve_at_10_v(run, ideal):
    """Σ p_i max(10 − r_i, 0) with eq (4) = 43.01835 µm."""
    assert displacement(run, ideal, "nominal", np.array([10.0]))[0] == pytest.approx(43.01835, abs=1e-5)


def test_loop_of_eq_4_at_10_v(run, ideal):
    """h/H = 14.659 % at ±10 V (the paper measured 16.3 % on the actuator itself)."""
    drive = periods(10.0)
    assert height_percent(drive, displacement(run, ideal, "nominal", drive)) == pytest.approx(14.659, abs=0.01)


def test_residual_truth_leaves_the_paper_s_loop(run, ideal):
    """An inverse of eq (4) on p_0 = 2.3834, p_6 = 0.25452 leaves h/H = 3.75 % at 40 µm."""
    command = periods(40.0)
    y = displacement(run, ideal, "residual", inverse_of_eq_4(command))
    assert height_percent(command, y) == pytest.approx(3.75, abs=0.02)


def test_nominal_truth_leaves_the_dead_band_only(run, ideal):
    """The exact formula with r_0 taken as 0 leaves 0.7471 µm at 40 µm from rest: r_0 = 0.095 V lost in each turn."""
    command = 40 * np.sin(2 * np.pi * np.arange(20001) / 10000)
    y = displacement(run, ideal, "nominal", inverse_of_eq_4(command))
    assert np.abs(y - command).max() == pytest.approx(0.7471, abs=1e-3)


@pytest.mark.parametrize(
    ("truth", "weights"),
    [("nominal", P), ("residual", np.array([2.3834, *P[1:6], 0.25452, *P[7:]]))],
)
def test_both_truths_are_the_operator_written_out(run, ideal, truth, weights):
    drive = np.cumsum(np.random.default_rng(1).normal(0, 2, 3000))
    drive = np.abs((drive + 10) % 40 - 20) - 10
    np.testing.assert_allclose(displacement(run, ideal, truth, drive), model_output(drive, weights), rtol=0, atol=1e-12)


def test_custom_model(run, ideal):
    """Two plays by hand: u = 3, 1, −3 V with r = 0, 1 and p = 2, 10 gives 6 + 20, 2 + 20, −6 − 20 µm."""
    plays = {"thresholds_v": (0.0, 1.0), "weights_um_per_v": (2.0, 10.0)}
    assert list(displacement(run, ideal, "custom", np.array([3.0, 1.0, -3.0]), **plays)) == [26.0, 22.0, -26.0]


def test_history_is_remembered(run, ideal):
    """A drive to 10 V and back leaves y = Σ p_i max(F, −r_i) there, at rest, which the sensor shows at once."""
    options = ideal(hysteresis=HysteresisOptions(truth="nominal", history_v=(10.0,)))
    remanent = model_output(np.array([10.0, 0.0]), P)[1]
    signals = run(np.zeros(500), options)
    np.testing.assert_allclose(signals.hysteresis_um, remanent, rtol=1e-13)
    # D(0) of eq (5) is 1.01086419: at rest from the first tick on.
    np.testing.assert_allclose(signals.true_um, 1.01086419 * remanent, rtol=1e-8)
    assert remanent > 1


@given(volts, thresholds, volts)
def test_play_is_the_definition_and_stays_within_its_threshold(drive, threshold, previous):
    """Krasnosel'skii & Pokrovskii 1989: max(u − r, min(u + r, y₋))."""
    output = play_output(drive, threshold, previous)
    assert output == max(drive - threshold, min(drive + threshold, previous))
    assert abs(output - drive) <= threshold + 1e-14


@given(volts, volts, thresholds, volts)
def test_play_is_monotone(first, second, threshold, previous):
    low, high = sorted((first, second))
    assert play_output(low, threshold, previous) <= play_output(high, threshold, previous)


@given(volts, volts, thresholds, st.lists(st.floats(0, 1), max_size=8))
def test_play_does_not_depend_on_the_rate(start, end, threshold, stops):
    """Intermediate drives, in ascending or descending order, do not change the output."""
    previous = play_output(start, threshold, 0.0)
    output = previous
    for share in (*sorted(stops), 1.0):
        output = play_output(end if share == 1.0 else start + share * (end - start), threshold, output)
    assert output == pytest.approx(play_output(end, threshold, previous), abs=1e-13)


@given(thresholds, volts)
def test_play_holds_on_nan(threshold, previous):
    assert play_output(float("nan"), threshold, previous) == previous


BOUC_WEN = {"um_per_v": 4.4, "rise_um_per_v": 0.9, "decay_per_v": 0.3, "lean_per_v": 0.1}


def bouc_wen(run, ideal, drive: np.ndarray) -> np.ndarray:
    """Return y (µm) of a Bouc-Wen rig for each drive (V)."""
    return displacement(run, ideal, "bouc-wen", drive, bouc_wen=BoucWenOptions(**BOUC_WEN))


def integrate_bouc_wen(turns_v: list[float], points: int) -> np.ndarray:
    """Return y (µm) along straight ways between the turns, by scipy's integration of the equation."""
    d, rise, decay, lean = BOUC_WEN.values()
    state_um, outputs = 0.0, []
    for start, end in pairwise(turns_v):
        way = end - start
        slope = lambda _, h, way=way: rise * way - decay * abs(way) * h - lean * way * np.abs(h)
        part = solve_ivp(slope, (0, 1), [state_um], rtol=1e-10, atol=1e-12, t_eval=np.linspace(0, 1, points + 1)[1:])
        state_um = part.y[0, -1]
        outputs.append(d * (start + way * part.t) - part.y[0])
    return np.concatenate(outputs)


@pytest.mark.parametrize("points", [1, 7, 400])
def test_bouc_wen_is_its_equation_at_any_rate(run, ideal, points):
    """A single step of 20 V and 400 steps of 50 mV give the same output."""
    turns = [0.0, 10.0, -10.0, 6.0, -2.0, 3.0, -10.0, 10.0]
    drive = np.concatenate([a + (b - a) * np.arange(1, points + 1) / points for a, b in pairwise(turns)])
    np.testing.assert_allclose(bouc_wen(run, ideal, drive), integrate_bouc_wen(turns, points), rtol=0, atol=2e-3)


def test_bouc_wen_does_not_move_on_nan(run, ideal):
    outputs = bouc_wen(run, ideal, np.array([5.0, np.nan, 5.0, 7.0]))
    assert outputs[0] == outputs[1] == outputs[2] < outputs[3]


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"truth": "bouc-wen"}, "bouc_wen: missing"),
        ({"bouc_wen": BOUC_WEN}, "bouc_wen is set, but truth is 'residual'"),
        (
            {"truth": "bouc-wen", "bouc_wen": BOUC_WEN | {"lean_per_v": -0.4}},
            r"lean_per_v: -0.4; allowed: -0.3 to 0.3, the value of decay_per_v",
        ),
    ],
)
def test_bad_numbers_of_bouc_wen_are_refused(options, match):
    with pytest.raises(ValueError, match=match):
        HysteresisOptions.model_validate(options)

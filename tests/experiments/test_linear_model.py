"""The responses that the configuration's models promise, against scipy's simulation of the same loop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from rtloop.configuration.axis import AxisOptions, ModelOptions
from rtloop.configuration.file import load
from rtloop.experiments.linear_model import LinearModel, linear_model
from rtloop.experiments.procedures.harmonic import hysteresis_db
from rtloop.experiments.procedures.harmonic_promise import HarmonicPromise

RATE_HZ = 10_000.0
OMEGA, ZETA, KI = 2 * np.pi * 300.0, 0.02, 60.0
DELAY_TICKS, TAPS = 2, (0.25, 0.5, 0.25)
AXIS = AxisOptions.model_validate(
    {
        "name": "x",
        "feedforward": {"thresholds_v": [0.0], "weights_um_per_v": [2.0]},
        "controller": {"form": "transfer_function", "numerator": [KI], "denominator": [1.0, 0.0], "method": "tustin"},
        "model": {
            "form": "transfer_function", "numerator": [OMEGA**2], "denominator": [1.0, 2 * ZETA * OMEGA, OMEGA**2],
            "delay_ticks": DELAY_TICKS,
        },
        "prefilter": {"taps": list(TAPS)},
    }
)  # fmt: skip
STEP = np.ones(4000)


def plant() -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator in z⁻¹ of the plant with zero-order hold and delay."""
    b, a, _ = signal.cont2discrete(([OMEGA**2], [1.0, 2 * ZETA * OMEGA, OMEGA**2]), 1 / RATE_HZ, "zoh")
    return np.concatenate([np.zeros(DELAY_TICKS), b.ravel()]), np.concatenate([a, np.zeros(DELAY_TICKS)])


def loop() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return numerators and denominators of T and of S in z⁻¹: L = C·P, C = K T/2 (1 + z⁻¹)/(1 − z⁻¹).

    The numerator of T is the numerator of L, and the numerator of S is the denominator of L.
    """
    b, a = plant()
    open_numerator = np.convolve(KI / (2 * RATE_HZ) * np.array([1.0, 1.0]), b)
    open_denominator = np.convolve([1.0, -1.0], a)
    closed = open_numerator + open_denominator
    return open_numerator, closed, open_denominator, closed


@pytest.fixture(scope="module")
def model() -> LinearModel:
    """The model of AXIS at RATE_HZ."""
    promise = linear_model(AXIS, RATE_HZ)
    return promise


def test_answers_to_a_step(model: LinearModel) -> None:
    open_numerator, closed, _open_denominator, _ = loop()
    open_position = signal.lfilter(*plant(), STEP)
    np.testing.assert_allclose(model.open_response(STEP), open_position, atol=1e-9)
    assert model.open_overshoot == pytest.approx(open_position.max(), abs=1e-9)
    response = model.closed_response(STEP)
    filtered = signal.lfilter(TAPS, 1.0, STEP)
    position = signal.lfilter(open_numerator, closed, filtered)
    np.testing.assert_allclose(response[0], position, atol=1e-9)
    command = signal.lfilter(np.convolve(KI / (2 * RATE_HZ) * np.array([1.0, 1.0]), plant()[1]), closed, filtered)
    np.testing.assert_allclose(response[1], command, atol=1e-9)


def test_response_to_a_disturbance(model: LinearModel) -> None:
    b, a, _ = signal.cont2discrete(([OMEGA**2], [1.0, 2 * ZETA * OMEGA, OMEGA**2]), 1 / RATE_HZ, "zoh")
    disturbance_um = signal.lfilter(b.ravel(), a, STEP)
    _, _, open_denominator, closed = loop()
    remaining = model.disturbance_response(STEP)
    np.testing.assert_allclose(remaining, signal.lfilter(open_denominator, closed, disturbance_um), atol=1e-9)


def test_responses(model: LinearModel) -> None:
    hz = np.array([0.1, 20.0, 299.0, 2000.0])
    z_inverse = np.exp(-2j * np.pi * hz / RATE_HZ)
    open_numerator, closed, open_denominator, _ = (np.polyval(fraction[::-1], z_inverse) for fraction in loop())
    numerator, denominator = (np.polyval(fraction[::-1], z_inverse) for fraction in plant())
    np.testing.assert_allclose(model.plant(hz), numerator / denominator, rtol=1e-9)
    filtered = TAPS[0] + TAPS[1] * z_inverse + TAPS[2] * z_inverse**2
    tracking, rejection = model.tracking(hz), model.rejection(hz)
    np.testing.assert_allclose(tracking, open_numerator / closed * filtered, rtol=1e-9)
    np.testing.assert_allclose(rejection, open_denominator / closed * numerator / denominator, rtol=1e-9)


def test_resonance_and_peaks(model: LinearModel) -> None:
    assert model.resonance_hz == pytest.approx(300.0)
    assert model.decay_per_s == pytest.approx(ZETA * OMEGA)
    assert model.open_peak == pytest.approx(1 / (2 * ZETA), rel=0.01)
    tolerated = model.tolerated_shifts
    for shift in (0.1 - tolerated.down, -0.1 - tolerated.down):
        omega = OMEGA * (1 + shift / 100)
        b, a, _ = signal.cont2discrete(([omega**2], [1.0, 2 * ZETA * omega, omega**2]), 1 / RATE_HZ, "zoh")
        padded = np.concatenate([np.zeros(DELAY_TICKS), b.ravel()]), np.concatenate([a, np.zeros(DELAY_TICKS)])
        closed = np.convolve(KI / (2 * RATE_HZ) * np.array([1.0, 1.0]), padded[0]) + np.convolve([1.0, -1.0], padded[1])
        assert bool(np.abs(np.roots(closed)).max() < 1) is bool(shift > -tolerated.down)


@pytest.mark.parametrize(("hz", "zeta"), [(15_000.0, 0.02), (1_234.5, 0.0005)])
def test_the_peak_of_a_plant_of_two_modes(hz: float, zeta: float) -> None:
    """The upper mode is above 10 kHz, or narrow. The oracle is scipy's response of the held plant on a dense grid."""
    rate_hz, omega = 50_000.0, 2 * np.pi * hz
    first, second = np.array([1.0, 1.8 * zeta * OMEGA, OMEGA**2]), np.array([1.0, 2 * zeta * omega, omega**2])
    numerator, denominator = np.polyadd(0.2 * OMEGA**2 * second, 0.8 * omega**2 * first), np.polymul(first, second)
    model = ModelOptions(form="transfer_function", numerator=tuple(numerator), denominator=tuple(denominator))
    b, a, _ = signal.cont2discrete((numerator, denominator), 1 / rate_hz, "zoh")
    _, response = signal.freqz(b.ravel(), a, np.linspace(0.9, 1.1, 20_001) * hz, fs=rate_hz)
    assert LinearModel(AXIS, model, rate_hz).open_peak == pytest.approx(np.abs(response).max(), rel=0.01)


def test_a_harmonic_response_is_promised(model: LinearModel) -> None:
    frequencies_hz = np.array([0.1, 1.0, 10.0, 250.0, 299.0, 300.0, 1000.0])
    promise = HarmonicPromise(model, frequencies_hz, RATE_HZ)
    assert promise.peak_hz == pytest.approx(300.0, abs=0.5)
    assert promise.peak_db == pytest.approx(20 * np.log10(1 / (2 * ZETA)), abs=0.1)
    assert promise.bandwidth_hz == pytest.approx(KI / (2 * np.pi), rel=0.05)  # I-control of a stiff plant
    empty = HarmonicPromise(None, frequencies_hz, RATE_HZ)
    assert (empty.peak_hz, empty.peak_db, empty.bandwidth_hz, empty.closed_low_db) == (None,) * 4
    assert empty.curves((None, None)) == []


def test_without_controller_or_stability_nothing_is_promised_of_the_loop() -> None:
    bare_plant = linear_model(AXIS.model_copy(update={"controller": None}), RATE_HZ)
    loop_answers = bare_plant.tracking(1.0), bare_plant.rejection(1.0), bare_plant.closed_response(STEP)
    assert (bare_plant.loop, *loop_answers, bare_plant.step_peak) == (None,) * 5
    unstable_controller = AXIS.controller.model_copy(update={"numerator": (1000 * KI,), "allow_unstable": True})
    unstable = linear_model(AXIS.model_copy(update={"controller": unstable_controller}), RATE_HZ)
    assert unstable.loop is None
    assert linear_model(AXIS.model_copy(update={"model": None}), RATE_HZ) is None


JUMPING_LAW = """
from rtloop.laws import Controller

class Mine(Controller):
    coefficients = {"ki": float}
    state = {"integral_um": float}

    def build(self):
        return {"ki": 60.0 * self.period_s}

    def output(c, s, told):
        return s.integral_um + 0.001 if told.error_um > 0.0 else s.integral_um

    def update(c, s, told):
        s.integral_um += c.ki * told.error_um
"""
"""A law whose command jumps where the error changes its sign, at rest."""


def test_of_a_law_that_is_not_linear_the_plant_alone_is_promised(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(JUMPING_LAW)
    axis = AxisOptions.model_validate(
        {
            "name": "x", "feedforward": {"thresholds_v": [0.0], "weights_um_per_v": [2.0]},
            "controller": {"file": str(tmp_path / "mine.py")}, "model": AXIS.model,
        }
    )  # fmt: skip
    promise = linear_model(axis, RATE_HZ)
    assert (promise.loop, promise.tracking(1.0), promise.step_peak, promise.tolerated_shifts) == (None,) * 4
    assert promise.build_loop(promise.dynamics) is None
    np.testing.assert_allclose(promise.open_response(STEP), signal.lfilter(*plant(), STEP), atol=1e-9)


@pytest.mark.parametrize(("stated_ticks", "rig_ticks"), [(None, DELAY_TICKS), (DELAY_TICKS, 0), (DELAY_TICKS, 7)])
def test_the_delay_is_the_rigs_if_the_model_states_none(stated_ticks: int | None, rig_ticks: int) -> None:
    values = {"form": "transfer_function", "numerator": [OMEGA**2], "denominator": [1.0, 2 * ZETA * OMEGA, OMEGA**2]}
    stated = {} if stated_ticks is None else {"delay_ticks": stated_ticks}
    axis = AXIS.model_copy(update={"model": ModelOptions.model_validate(values | stated)})
    promise = linear_model(axis, RATE_HZ, rig_ticks)
    np.testing.assert_allclose(promise.open_response(STEP), signal.lfilter(*plant(), STEP), atol=1e-9)
    open_numerator, closed, _open_denominator, _ = loop()
    position = signal.lfilter(open_numerator, closed, signal.lfilter(TAPS, 1.0, STEP))
    np.testing.assert_allclose(promise.closed_response(STEP)[0], position, atol=1e-9)
    shifted = promise.build_loop(promise.dynamics)
    np.testing.assert_allclose(np.sort_complex(shifted.poles), np.sort_complex(promise.loop.poles), atol=1e-9)


def test_the_papers_printed_equations() -> None:
    """The figures are from numpy and scipy scripts without code of rtloop: plays sample by sample, D(s), C(s)."""
    axis = load(Path(__file__).resolve().parents[2] / "deploy" / "paper.toml").axes[0]
    promise = linear_model(axis, RATE_HZ)
    assert promise.resonance_hz == pytest.approx(595.50, abs=0.01)
    assert promise.step_peak == pytest.approx(1.396, abs=0.001)
    tracking = promise.tracking(0.01)
    assert 20 * np.log10(abs(tracking[0])) == pytest.approx(-0.0145, abs=1e-4)
    actuator, inverse = axis.feedforward.actuator(), axis.feedforward.models()[1]
    raw, behind_inverse = hysteresis_db(actuator, inverse, 4.30185, 2.0)
    at_rest_db = 20 * np.log10(1.01086)
    assert (raw + at_rest_db, behind_inverse + at_rest_db) == pytest.approx((-5.213, -0.746), abs=0.002)

"""Dynamics identified from steps and chirps, against the rig's poles and mpmath; unsuitable recordings are refused."""

from __future__ import annotations

import dataclasses

import mpmath
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, dlsim

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.dynamics.identify_dynamics import identify_dynamics
from rtloop.design.identification.dynamics.identify_in_loop import identify_recorded_dynamics
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.inverse_hold import continuous_modal
from rtloop.design.identification.dynamics.markov import fit_residues
from rtloop.design.identification.dynamics.prediction_error import Excitation, excited_order
from rtloop.design.identification.dynamics.residuals import residual_tests
from rtloop.design.identification.frequency_response import compare_responses, estimate_response
from rtloop.design.paper import PAPER_D
from rtloop.foundation.modal import ModalSystem, modal_sum
from tests.design.rigs import (
    EQ_4,
    FAST_S,
    chirp_drive,
    draw_rig,
    identify_rig,
    model_errors,
    model_excitation,
    step_drive,
)

PAIR_AND_REAL = Innovations(
    FAST_S,
    np.array([-200 + 3000j, -500 + 0j]),
    np.array([0.02 - 0.01j, 0.03 + 0j]),
    np.array([0.05 + 0.02j, 0.1 + 0j]),
    0.3,
)


@pytest.mark.parametrize("seed", [201, 202])
def test_a_drawn_rig_comes_out_of_a_slow_sine_and_a_step(seed: int) -> None:
    rig = draw_rig(seed)
    errors = model_errors(rig, *identify_rig(rig))
    print(f"seed {seed}: {errors}")
    assert errors.loop_percent <= 1.0
    assert abs(errors.resonance_percent) <= 0.5
    assert abs(errors.damping_percent) <= 20.0
    assert abs(errors.gain_percent) <= 1.0


def test_a_chirp_serves_as_well_and_so_does_validation_on_a_step() -> None:
    rig = draw_rig(204)
    model = type(EQ_4)(rig.thresholds, rig.weights)
    chirp, step = (model_excitation(model, rig.measure(drive, FAST_S)) for drive in (chirp_drive(), step_drive()))
    fit = identify_dynamics(chirp, largest_order=4, criterion="validation", validation=[step])
    light = min(fit.modes, key=lambda mode: mode.damping)
    assert light.frequency_hz == pytest.approx(rig.resonance_hz, rel=0.005)
    assert light.damping == pytest.approx(rig.damping, rel=0.2)
    assert abs(light.frequency_hz - rig.resonance_hz) < 0.5
    assert fit.static_gain == pytest.approx(rig.d0, rel=0.01)
    assert fit.transfer.dc_gain == pytest.approx(1.0, abs=1e-12)
    assert min(candidate.validation_rms_um for candidate in fit.candidates) < 0.2


@pytest.mark.parametrize("signs", [(-1.0, 1.0), (1.0, -1.0)])
def test_a_stage_that_moves_against_its_drive_is_named(signs: tuple[float, float]) -> None:
    """The sensor or the drive has the wrong sign."""
    rig = draw_rig(204)
    run = model_excitation(type(EQ_4)(rig.thresholds, rig.weights), rig.measure(step_drive(), FAST_S))
    inverted = Excitation(run.name, signs[0] * run.input, signs[1] * run.position_um, run.period_s)
    with pytest.raises(
        UnsuitableData,
        match=r"the sign of drive or position is wrong: .* falls where the drive rises, by 1\.0.* um_per_v",
    ):
        identify_recorded_dynamics(inverted, largest_order=4)


def test_the_measured_frequency_response_agrees_where_it_is_coherent() -> None:
    rig = draw_rig(205)
    model = type(EQ_4)(rig.thresholds, rig.weights)
    fit = identify_dynamics(model_excitation(model, rig.measure(step_drive(), FAST_S)), order=4)
    chirp = model_excitation(model, rig.measure(chirp_drive(duration_s=4.0), FAST_S))
    comparison = compare_responses(fit.model, estimate_response(chirp.input, chirp.position_um, FAST_S))
    assert comparison.median_deviation < 0.02
    assert comparison.from_hz < 20
    assert comparison.to_hz > 900


def test_standard_deviations_are_those_of_repeated_experiments() -> None:
    """Over 12 recordings with independent noise, the estimates spread as their reported deviations state."""
    drive, random = step_drive(duration_s=0.4), np.random.default_rng(3)
    clean = Innovations(FAST_S, PAIR_AND_REAL.rates, PAIR_AND_REAL.residues, np.zeros(2, complex)).simulate_output(
        drive
    )
    runs = [Excitation("made", drive, clean + random.normal(0, 0.02, drive.size), FAST_S) for _ in range(12)]
    fits = [identify_dynamics(run, order=3) for run in runs]
    pair_modes = [min(fit.modes, key=lambda mode: mode.damping) for fit in fits]
    natural_hz, damping = abs(PAIR_AND_REAL.rates[0]) / (2 * np.pi), 200 / abs(PAIR_AND_REAL.rates[0])
    for values, deviations, true in (
        ([mode.frequency_hz for mode in pair_modes], [mode.frequency_std_hz for mode in pair_modes], natural_hz),
        ([mode.damping for mode in pair_modes], [mode.damping_std for mode in pair_modes], damping),
    ):
        assert np.std(values) == pytest.approx(np.mean(deviations), rel=0.6)
        assert abs(np.mean(values) - true) < 4 * np.mean(deviations) / np.sqrt(12)


def test_sensitivities_are_the_derivatives_of_the_errors() -> None:
    random = np.random.default_rng(1)
    u, y = random.normal(size=400), random.normal(size=400)
    errors = PAIR_AND_REAL.errors(u, y)
    assert errors is not None
    rows = PAIR_AND_REAL.sensitivities(u, errors, noise=True)
    values = PAIR_AND_REAL.pack(noise=True)
    for i, row in enumerate(rows):
        h = 1e-6 * max(abs(values[i]), 1.0)
        shifted = [
            PAIR_AND_REAL.unpack(values + s * h * np.eye(values.size)[i], noise=True).errors(u, y) for s in (1, -1)
        ]
        assert np.allclose((shifted[0] - shifted[1]) / (2 * h), row, rtol=1e-5, atol=1e-6 * np.abs(row).max())


def test_residues_are_fitted_under_the_noise_model() -> None:
    """The fit from zero residues equals the least squares that scipy finds with numerical derivatives of the errors."""
    random = np.random.default_rng(3)
    u, noise = random.normal(size=400), 0.01 * random.normal(size=400)
    y = PAIR_AND_REAL.simulate_output(u) + noise

    def make_model(values: np.ndarray) -> Innovations:
        residues = np.array([values[0] + 1j * values[1], values[2]])
        return dataclasses.replace(PAIR_AND_REAL, residues=residues, offset=float(values[3]))

    optimum = least_squares(lambda values: make_model(values).errors(u, y), np.zeros(4), jac="3-point", xtol=1e-14)
    fitted = fit_residues(make_model(np.zeros(4)), u, y)
    assert np.allclose(fitted.residues, make_model(optimum.x).residues, atol=1e-8)
    assert fitted.offset == pytest.approx(optimum.x[3], abs=1e-8)


def test_errors_are_those_of_the_armax_polynomials() -> None:
    """The oracle is ε from A y − B u = C ε with multiplied-out polynomials, which is accurate for three poles."""
    random = np.random.default_rng(2)
    u, y = random.normal(size=50), random.normal(size=50)
    z_poles, pair = PAIR_AND_REAL.z_poles, PAIR_AND_REAL.discrete()
    a = np.poly([z_poles[0], z_poles[0].conj(), z_poles[1]]).real

    def numerator(residues: np.ndarray) -> np.ndarray:
        terms = [np.poly(np.delete(pair.poles, i)) * r for i, r in enumerate(residues)]
        return np.sum(terms, axis=0).real

    gains = PAIR_AND_REAL.noise_gains
    b = numerator(pair.residues[0])
    c = a + np.concatenate([[0.0], numerator(np.array([gains[0], gains[1], gains[0].conj()]))])
    centred, expected = y - PAIR_AND_REAL.offset, np.zeros(50)
    delayed = lambda signal, k, i: signal[k - i] if k >= i else 0.0
    for k in range(50):
        expected[k] = centred[k] + sum(a[i] * delayed(centred, k, i) for i in (1, 2, 3))
        expected[k] -= sum(b[i] * delayed(u, k, i + 1) for i in range(3))
        expected[k] -= sum(c[i] * delayed(expected, k, i) for i in (1, 2, 3))
    assert np.allclose(PAIR_AND_REAL.errors(u, y), expected, atol=1e-10)


def hold_exactly(modal: ModalSystem, period_s: float) -> list[tuple[mpmath.mpc, mpmath.mpc]]:
    """Return (pole, residue) in z of each mode behind a zero-order hold, at mpmath's working precision."""
    modes = []
    for pole, residue in zip(modal.poles, modal.residues[0], strict=True):
        p, r = mpmath.mpc(pole), mpmath.mpc(residue)
        pole_z = mpmath.exp(p * mpmath.mpf(period_s))
        modes.append((pole_z, r * (pole_z - 1) / p))
    return modes


@pytest.mark.parametrize("case", ["eq 5 below 5 kHz", "order 20", "-1 beside -1e5 rad/s"])
def test_the_inverse_hold_keeps_its_digits(case: str) -> None:
    """Discrete modes computed by mpmath at 50 digits, rounded to double, are converted back to the continuous ones."""
    random = np.random.default_rng(5)
    if case == "order 20":
        upper = -random.uniform(1, 500, 10) + 1j * np.geomspace(10, 2e4, 10)
        modal = ModalSystem(np.concatenate([upper, upper.conj()]), np.ones((1, 20), complex), np.zeros(1))
    elif case == "eq 5 below 5 kHz":
        full = modal_sum(PAPER_D.zeros, PAPER_D.poles, PAPER_D.gain)
        below_nyquist = np.abs(full.poles.imag) < np.pi / FAST_S
        modal = ModalSystem(full.poles[below_nyquist], full.residues[:, below_nyquist], np.zeros(1))
    else:
        modal = ModalSystem(np.array([-1.0 + 0j, -1e5 + 0j]), np.array([[2.0 + 0j, -3e4 + 0j]]), np.zeros(1))
    with mpmath.workdps(50):
        exact = hold_exactly(modal, FAST_S)
    discrete = ModalSystem(
        np.array([complex(pole) for pole, _ in exact]), np.array([[complex(r) for _, r in exact]]), np.zeros(1)
    )
    rates = np.log(discrete.poles) / FAST_S
    recovered = continuous_modal(rates, discrete.residues, discrete.direct, FAST_S)
    # In double precision, a pole in z near 1 determines −1 rad/s at 1e-4 s only to 1e-16/1e-4.
    tolerance = 1e-15 / np.abs(modal.poles * FAST_S) + 1e-14
    assert np.all(np.abs(recovered.poles / modal.poles - 1) < tolerance)
    assert np.all(np.abs(recovered.residues[0] / modal.residues[0] - 1) < 4 * tolerance)


def test_twenty_modes_and_slow_beside_fast_are_predicted_exactly() -> None:
    """The output of order 20, with real poles at −1 and −1e5 rad/s, agrees with a recursion by mpmath at 50 digits."""
    rates = np.concatenate([[-1.0 + 0j, -1e5 + 0j], -np.geomspace(5, 900, 9) + 1j * np.geomspace(20, 25e3, 9)])
    residues = np.concatenate([[1e-4 + 0j, 0.5 + 0j], (0.01 + 0.02j) * np.ones(9)])
    model = Innovations(FAST_S, rates, residues, np.zeros(11, complex))
    assert model.order == 20
    u = np.random.default_rng(4).normal(size=300)
    with mpmath.workdps(50):
        z_poles = [mpmath.exp(mpmath.mpc(rate) * mpmath.mpf(FAST_S)) for rate in rates]
        states, expected = [mpmath.mpc(0)] * 11, []
        for value in u:
            sums = [(2 if rate.imag else 1) * r * x for rate, r, x in zip(rates, residues, states, strict=True)]
            expected.append(float(mpmath.fsum(sums).real))
            states = [pole * x + mpmath.mpf(float(value)) for pole, x in zip(z_poles, states, strict=True)]
    assert np.allclose(model.simulate_output(u), expected, rtol=1e-11, atol=1e-12)


def test_residual_tests_tell_white_from_coloured_and_dependent() -> None:
    random = np.random.default_rng(6)
    u, e = random.normal(size=5000), random.normal(size=5000)
    assert residual_tests(u, e, 6).is_white
    assert residual_tests(u, e, 6).is_independent
    coloured = e + 0.5 * np.roll(e, 1)
    assert not residual_tests(u, coloured, 6).is_white
    assert not residual_tests(u, e + 0.3 * np.concatenate([[0, 0], np.diff(u)[:-1]]), 6).is_independent


def test_a_slow_sine_is_too_little_for_dynamics() -> None:
    time_s = FAST_S * np.arange(20_000)
    slow = 10 * np.sin(2 * np.pi * 0.5 * time_s)
    run = Excitation("slow", slow, 4 * slow + np.random.default_rng(1).normal(0, 0.01, slow.size), FAST_S)
    assert excited_order(run) <= 2
    with pytest.raises(
        UnsuitableData, match=r"too little excitation: this input identifies at most .* Use a step, or a chirp"
    ):
        identify_dynamics(run, order=4)
    with pytest.raises(UnsuitableData, match="too little excitation"):
        identify_dynamics(run)


def test_validation_without_a_recording_to_validate_on_is_a_contradiction() -> None:
    run = Excitation("made", step_drive(), step_drive(), FAST_S)
    with pytest.raises(ValueError, match="criterion 'validation' needs another recording"):
        identify_dynamics(run, criterion="validation")


def test_a_model_of_no_numbers_predicts_nothing() -> None:
    """The optimiser may try a model with infinite gains; `errors` returns None for it."""
    model = Innovations(1e-4, np.array([-100.0 + 0j]), np.array([1.0 + 0j]), np.array([np.inf + 0j]), 0.0)
    assert model.errors(np.ones(10), np.ones(10)) is None


def test_a_wrong_level_of_the_way_down_hides_no_pole() -> None:
    """A mode with a sensor's lag; the drive returns to 0.3 µm, and the model of the hysteresis says 0 µm."""
    w, lag = 2 * np.pi * 332.46, 2 * np.pi * 1136.0
    a = np.array([[0, 1, 0], [-w * w, -2 * 0.00438 * w, 0], [lag, 0, -lag]])
    b, c = np.array([[0], [w * w], [0]]), np.array([[0, 0, 1.0]])
    drive = np.repeat([0.0, 20.0, 0.3], (1000, 5000, 5000))
    _, position, _ = dlsim(cont2discrete((a, b, c, np.zeros((1, 1))), FAST_S), drive)
    noise = 0.009 * np.random.default_rng(7).standard_normal(drive.size)
    stated = np.where(drive == 20.0, 20.0, 0.0)
    fit = identify_dynamics(Excitation("down", stated, position[:, 0] + noise, FAST_S))
    light = min(fit.modes, key=lambda mode: mode.damping)
    assert (fit.model.order, fit.delay_ticks) == (3, 0)
    assert light.frequency_hz == pytest.approx(332.46, abs=0.005)
    assert light.damping == pytest.approx(0.00438, rel=0.005)
    assert max(mode.frequency_hz for mode in fit.modes) == pytest.approx(1136.0, rel=0.05)
    assert fit.tests.is_independent


def test_errors_that_follow_from_the_input_bar_an_order() -> None:
    """A second mode of 1.2 % lowers the rms error by 0.6 %, too little for a pole, but the input shows through."""
    a, b, c = np.zeros((4, 4)), np.zeros((4, 1)), np.array([[1.0, 0, 1.0, 0]])
    for i, (hz, damping, gain) in enumerate(((300.0, 0.02, 1.0), (3000.0, 0.7, 0.012))):
        w = 2 * np.pi * hz
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0, 1], [-w * w, -2 * damping * w]]
        b[2 * i + 1] = gain * w * w
    random = np.random.default_rng(5)
    drive = np.cumprod(np.where(random.random(30_000) < 0.85, -1.0, 1.0))
    drive[:200] = 0.0
    _, position, _ = dlsim(cont2discrete((a, b, c, np.zeros((1, 1))), FAST_S), drive)
    run = Excitation("signs", drive, position[:, 0] + 0.05 * random.standard_normal(drive.size), FAST_S)
    fit = identify_dynamics(run, largest_order=3, criterion="aic", delay_ticks=0)
    rms_um = {candidate.order: candidate.rms_error_um for candidate in fit.candidates}
    assert rms_um[2] < 1.01 * rms_um[3]
    assert fit.model.order == 3
    assert abs(fit.static_gain - 1.012) < 3 * fit.static_gain_std

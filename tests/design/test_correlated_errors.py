"""Standard deviations under noise that the noise model lacks; correction of levels that the hysteresis model misses."""

import numpy as np
import pytest
from scipy.signal import lfilter

from rtloop.design.identification.dynamics.dynamics_fit import estimate_modes, static_gain_std
from rtloop.design.identification.dynamics.estimate_covariance import estimate_covariance
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.measured_levels import correct_levels
from rtloop.design.identification.dynamics.prediction_error import Excitation, minimise_errors

PERIOD_S, TICKS, DWELL_TICKS, NOISE_UM = 1e-4, 4000, 3000, 0.02
RESONANCE = 2 * np.pi * 800.0 * (-0.02 + 1j * np.sqrt(1 - 0.02**2))
NO_NOISE_GAINS = np.zeros(1, dtype=complex)
RESIDUE = np.array([-1j], dtype=complex)
SCALE = Innovations(PERIOD_S, np.array([RESONANCE]), RESIDUE, NO_NOISE_GAINS).static_gain
TRUTH = Innovations(PERIOD_S, np.array([RESONANCE]), np.array([RESIDUE[0] / SCALE]), NO_NOISE_GAINS)


@pytest.mark.parametrize("pole", [0.0, -0.9])
def test_standard_deviations_are_the_spread_of_estimates_under_coloured_noise(pole: float) -> None:
    """150 recordings are fitted with H = 1, while their noise is white (pole 0) or an autoregression (pole -0.9)."""
    random, u = np.random.default_rng(1), repeat_levels(TICKS // 2, 0.0, 20.0)
    values, stated, assumed_white = [], [], []
    narrowest, widest = 0.8, 1.25
    for _ in range(150):
        noise_um = lfilter([1.0], [1.0, -pole], random.normal(0.0, NOISE_UM, TICKS))
        run = Excitation("made", u, TRUTH.simulate_output(u) + noise_um, PERIOD_S)
        model = minimise_errors(TRUTH, run, noise=False)
        errors = model.errors(run.input, run.position_um)
        assert errors is not None
        covariances = [estimate_covariance(model, run, errors, white=white) for white in (False, True)]
        (mode,) = estimate_modes(model, covariances[0], noise=True)
        values.append([mode.frequency_hz, mode.damping, model.static_gain])
        for covariance, rows in zip(covariances, (stated, assumed_white), strict=True):
            (mode,) = estimate_modes(model, covariance, noise=True)
            rows.append([mode.frequency_std_hz, mode.damping_std, static_gain_std(model, covariance, noise=True)])
    spread = np.std(values, axis=0, ddof=1)
    ratios, white_ratios = (np.mean(rows, axis=0) / spread for rows in (stated, assumed_white))
    assert np.all((ratios > narrowest) & (ratios < widest)), ratios
    white_deviates = np.any((white_ratios < narrowest) | (white_ratios > widest))
    assert white_deviates == (pole != 0), white_ratios


def repeat_levels(dwell_ticks: int, *values: float) -> np.ndarray:
    """Return the values, each repeated for `dwell_ticks` samples."""
    return np.repeat(values, dwell_ticks).astype(float)


def misjudged_levels(dwell_ticks: int, added_um: np.ndarray | float = 0.0) -> Excitation:
    """Return a recording: the hysteresis model gives 20.0 and 3.1 µm where the actuator holds 20.3 and 3.0."""
    true_um = repeat_levels(dwell_ticks, 0.0, 20.3, 0.0, 3.0)
    noise_um = np.random.default_rng(2).normal(0.0, NOISE_UM, true_um.size)
    position_um = TRUTH.simulate_output(true_um) + noise_um + added_um
    return Excitation("made", repeat_levels(dwell_ticks, 0.0, 20.0, 0.0, 3.1), position_um, PERIOD_S)


def test_levels_that_the_hysteresis_model_misses_are_measured() -> None:
    """Corrected levels are proportional to the true ones; the factor is left to the static gain."""
    misjudged = misjudged_levels(DWELL_TICKS)
    corrected, largest_correction_um = correct_levels(misjudged)
    _, high, low, last = corrected.input[DWELL_TICKS // 2 :: DWELL_TICKS]
    assert high / 20.3 == pytest.approx(last / 3.0, rel=1e-3)
    assert low == pytest.approx(0.0, abs=2e-3)
    assert largest_correction_um == pytest.approx(np.abs(corrected.input - misjudged.input).max())


@pytest.mark.parametrize("reason", ["drift", "ringing", "short holds", "two levels"])
def test_levels_are_left_alone_where_they_cannot_be_measured(reason: str) -> None:
    time_s, u = PERIOD_S * np.arange(4 * DWELL_TICKS), repeat_levels(DWELL_TICKS, 0.0, 20.0)
    added_um = {"drift": 0.1 * time_s, "ringing": 0.1 * np.sin(5000.0 * time_s)}.get(reason, 0.0)
    run = misjudged_levels(80 if reason == "short holds" else DWELL_TICKS, added_um)
    if reason == "two levels":
        run = Excitation("made", u, 1.01 * TRUTH.simulate_output(u), PERIOD_S)
    assert correct_levels(run) == (run, 0.0)

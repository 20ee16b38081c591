"""Delay in whole samples, identified from recordings of simulated rigs of one mode with a known delay."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.dynamics.dynamics_fit import estimate_modes
from rtloop.design.identification.dynamics.identify_delay import Candidate, simplest_candidate
from rtloop.design.identification.dynamics.identify_dynamics import identify_dynamics
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.hil.options import DynamicsOptions, HysteresisOptions, PlantOptions, RigOptions, SensorOptions
from rtloop.hil.rig import build_rig
from tests.design.rigs import record_readings

PERIOD_S, GAIN_UM_PER_V = 1e-4, 2.0


def excitation(
    hz: float, damping: float, delay_ticks: int, drive_v: np.ndarray, lag_hz: float | None = None
) -> Excitation:
    """Return the input (µm) and position of a linear rig: one mode, a lag if `lag_hz`, 10 nm of noise, converters."""
    omega = 2 * np.pi * hz
    lag_rad_s = () if lag_hz is None else (2 * np.pi * lag_hz,)
    rig = RigOptions(
        plant=PlantOptions(
            hysteresis=HysteresisOptions(truth="custom", thresholds_v=(0.0,), weights_um_per_v=(GAIN_UM_PER_V,)),
            dynamics=DynamicsOptions(
                form="factors",
                gain=float(np.prod((omega**2, *lag_rad_s))),
                denominator=((1.0, 2 * damping * omega, omega**2), *((1.0, rate) for rate in lag_rad_s)),
            ),
            sensor=SensorOptions(um_per_v=10.0, noise_um=0.010),
        ),
        seed=3,
        latency_ticks=delay_ticks,
    )
    coefficients, state = build_rig(rig, ["x"], PERIOD_S)
    adc_v = np.empty(drive_v.size)
    record_readings(coefficients, state, drive_v, adc_v)
    return Excitation("rig", GAIN_UM_PER_V * drive_v, 10.0 * adc_v, PERIOD_S)


def up_and_down_drive(duration_s: float = 0.6) -> np.ndarray:
    """Return a drive (V): 0, then 10 from 0.05 s to 55 % of the duration, then 0."""
    time_s = PERIOD_S * np.arange(round(duration_s / PERIOD_S))
    return np.where((time_s >= 0.05) & (time_s < 0.55 * duration_s), 10.0, 0.0)


@pytest.mark.parametrize(
    ("drive", "delay_ticks"),
    [("up and down", 0), ("up and down", 5), ("one step", 1), ("one step", 4)],
)
def test_the_delay_is_found_and_no_pole_stands_in_for_it(drive, delay_ticks) -> None:
    """Up and down leaves the second half for a test of the fit; one step leaves only the fit itself."""
    drive_v = up_and_down_drive() if drive == "up and down" else np.where(np.arange(3000) < 500, 0.0, 10.0)
    fit = identify_dynamics(excitation(800.0, 0.02, delay_ticks, drive_v))
    assert fit.delay_ticks == delay_ticks
    assert fit.model.order == 2
    (mode,) = fit.modes
    assert mode.frequency_hz == pytest.approx(800.0, rel=1e-3)
    assert mode.damping == pytest.approx(0.02, rel=0.02)


def test_a_noisy_drive_tells_the_delay_too() -> None:
    drive_v = np.random.default_rng(5).uniform(-5, 5, 4000)
    drive_v[:200] = 0.0
    assert identify_dynamics(excitation(300.0, 0.01, 2, drive_v)).delay_ticks == 2


def test_a_fast_lag_does_not_stand_in_for_a_sample_of_delay() -> None:
    fit = identify_dynamics(excitation(800.0, 0.02, 2, up_and_down_drive(0.3), 4000.0), criterion="held-out")
    assert fit.delay_ticks == 2
    lag = max(fit.modes, key=lambda mode: mode.damping)
    assert abs(lag.frequency_hz - 4000.0) < 4 * lag.frequency_std_hz


def test_a_lag_that_the_errors_need_is_not_left_out() -> None:
    """The lag's pole is uncertain by more than itself; without it, the errors would follow from the input."""
    fit = identify_dynamics(excitation(227.57, 0.0051, 1, up_and_down_drive(1.1), 3561.0))
    assert (fit.model.order, fit.delay_ticks, fit.left_out_hz) == (3, 1, ())
    assert fit.tests.is_independent


FIVE_POLES, THREE_POLES = Candidate(0, 5, 0.03, 0.03, True), Candidate(3, 3, 0.031, 0.03, True)


@pytest.mark.parametrize(
    ("candidates", "delay_ticks"),
    [
        ([FIVE_POLES, THREE_POLES], 3),
        ([FIVE_POLES, THREE_POLES._replace(refitted_rms_um=0.0304)], 0),
        ([FIVE_POLES, THREE_POLES._replace(rms_um=0.0302, refitted_rms_um=0.0304)], 3),
        ([FIVE_POLES._replace(rms_um=0.02, is_independent=False), THREE_POLES], 3),
        ([FIVE_POLES._replace(is_independent=False)], 0),
        ([THREE_POLES, THREE_POLES._replace(ticks=4, refitted_rms_um=0.030014)], 4),
        ([THREE_POLES, THREE_POLES._replace(ticks=4, refitted_rms_um=0.030016)], 3),
    ],
)
def test_fewest_poles_win_among_equally_good_predictions(candidates: list[Candidate], delay_ticks: int) -> None:
    """A candidate whose errors follow from the input counts only where there is no other."""
    assert simplest_candidate(candidates, 10_000).ticks == delay_ticks


def test_poles_and_zeros_do_not_stand_in_for_three_samples() -> None:
    """Five poles without delay predict the held-out half better by chance, and the whole recording equally well."""
    fit = identify_dynamics(excitation(562.443, 0.00839, 3, up_and_down_drive(1.1), 1963.0))
    assert (fit.model.order, fit.delay_ticks) == (3, 3)


@pytest.mark.parametrize("criterion", ["aic", "held-out"])
def test_creep_is_not_taken_for_a_mode(criterion) -> None:
    """Creep is 0.08 µm per factor e of time; a mode slower than the recording would fit it and falsify D(0)."""
    drive_v = up_and_down_drive()
    run = excitation(800.0, 0.02, 1, drive_v)
    creep_um = 0.08 * np.log1p(np.maximum(PERIOD_S * np.arange(drive_v.size) - 0.05, 0.0) / 0.01)
    fit = identify_dynamics(replace(run, position_um=run.position_um + creep_um), criterion=criterion)
    assert all(mode.frequency_hz > 1 / (2 * np.pi * PERIOD_S * drive_v.size) for mode in fit.modes)
    (light,) = [mode for mode in fit.modes if mode.damping < 0.1]
    assert light.frequency_hz == pytest.approx(800.0, rel=1e-3)
    assert light.static_share == pytest.approx(1.0, abs=0.02)


def test_a_stage_that_has_not_settled_by_the_end_is_refused() -> None:
    """A recording of 0.6 s of a plant with a lag of 2 s does not determine the final position."""
    run = Excitation("rig", up_and_down_drive(), np.zeros(6000), PERIOD_S)
    decay = 1 - np.exp(-PERIOD_S / 2.0)
    position_um = lfilter([0.0, decay], [1.0, decay - 1.0], run.input) + np.random.default_rng(1).normal(
        scale=1e-3, size=6000
    )
    with pytest.raises(
        UnsuitableData,
        match=r"drifts or creeps.* longer than the recording, for example 2\.?\d* s; the recording has 0\.6 s",
    ):
        identify_dynamics(replace(run, position_um=position_um), order=1, delay_ticks=0)


def test_a_mode_that_is_over_within_a_sample_has_no_spread() -> None:
    """The model has poles at z = 1e-9 and 0.01; the first decays within a sample, so its deviations are infinite."""
    rates = np.log([1e-9, 0.01]) / PERIOD_S
    model = Innovations(PERIOD_S, rates + 0j, np.array([0.5, 0.5]) + 0j, np.zeros(2, complex), 1.0)
    slow, fast = estimate_modes(model, np.eye(4), noise=False)
    assert slow.frequency_hz == pytest.approx(-np.log(0.01) / PERIOD_S / (2 * np.pi))
    assert np.isfinite(slow.frequency_std_hz)
    assert fast.frequency_hz == pytest.approx(14 / PERIOD_S / (2 * np.pi))
    assert (fast.frequency_std_hz, fast.damping_std) == (np.inf, np.inf)

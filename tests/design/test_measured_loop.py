"""Response of a closed loop from a multisine, compared with loops of known transfer function, simulated by scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from rtloop.analysis.closed_loop import discrete_loop
from rtloop.analysis.measured import excitation
from rtloop.analysis.measured.measurement import LoopMeasurement, measure_loop
from rtloop.analysis.measured.mode import fit_light_mode
from rtloop.analysis.measured.multisine import LineGrid, excitation_sequence, low_crest_amplitudes, make_grid
from rtloop.analysis.measured.recorded import find_periodic_part
from rtloop.analysis.measured.response import MeasuredResponse, PeriodSignals, measure_response
from rtloop.design.identification.plot_response import _format_margin
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer
from tests.design.measured_loops import RATE_HZ, TrueLoop

AMPLITUDE_UM, FADE = 0.5, 500
"""Largest motion (µm), and ticks in which the excitation fades out."""
LOOPS = (
    TrueLoop(595.5, 0.007, 0, 30.0),
    TrueLoop(595.5, 0.007, 1, 40.0),
    TrueLoop(320.0, 0.01, 2, 25.0),
    TrueLoop(1500.0, 0.02, 1, 500.0, kp=0.02),
    TrueLoop(150.0, 0.02, 0, 20.0),
)


def split_periods(lines: LineGrid, signals: dict[str, np.ndarray], periods: int) -> PeriodSignals:
    """Return error, command and position of `periods` periods of the multisine, from the second on."""
    parts = (signals[name][lines.samples : (periods + 1) * lines.samples].reshape(periods, -1)
             for name in ("error_um", "command_um", "position_um"))  # fmt: skip
    return PeriodSignals(*parts)


def measure(loop: TrueLoop, near_hz: float, periods: int = 4, seed: int = 0) -> tuple[LoopMeasurement, float]:
    """Measure a loop as the service does. Return the measurement and the largest |true position| (µm) of all runs."""
    lines = make_grid(RATE_HZ, 1.0, 2.0, 4400.0, near_hz)
    period, largest_um = excitation.first_period(lines, AMPLITUDE_UM), 0.0
    signals = loop.run(excitation_sequence(period, 2, 0.0, FADE), seed)
    for ratio in excitation.AMPLITUDE_RATIOS:
        largest_um = max(largest_um, float(np.abs(signals["true_um"]).max()))
        period = excitation.shape_period(lines, period, split_periods(lines, signals, 2), AMPLITUDE_UM, ratio)
        count = periods if ratio == excitation.AMPLITUDE_RATIOS[-1] else 2
        signals = loop.run(excitation_sequence(period, count, 0.0, FADE), seed + 1)
    return measure_loop(signals, RATE_HZ, near_hz), max(largest_um, float(np.abs(signals["true_um"]).max()))


@pytest.mark.parametrize("loop", LOOPS, ids=lambda loop: f"{loop.hz:g} Hz, delay {loop.delay_ticks}")
def test_margins_are_those_of_the_loop_and_the_position_keeps_within_the_amplitude(loop: TrueLoop) -> None:
    measurement, largest_um = measure(loop, near_hz=1.05 * loop.hz)
    true = loop.margins(measurement.response.hz[0], measurement.response.hz[-1])
    assert measurement.margins.gain_margin.value == pytest.approx(true["gain_margin"], rel=0.02)
    assert measurement.margins.phase_margin_deg.value == pytest.approx(true["phase_margin_deg"], abs=2.0)
    assert measurement.margins.modulus_margin.value == pytest.approx(true["modulus_margin"], rel=0.02)
    assert largest_um <= AMPLITUDE_UM


@pytest.mark.parametrize("noise_um", [0.010, 0.100])
@pytest.mark.parametrize("shift", [-0.1, 0.0, 0.1])
def test_a_shifted_resonance_is_found(shift: float, noise_um: float) -> None:
    """Retuning needs 0.06 % with noise of 10 nm, and 0.25 % with 100 nm."""
    loop = TrueLoop(595.5 * (1 + shift), 0.007, 1, 20.0, noise_um=noise_um)
    measurement, _ = measure(loop, near_hz=595.5)
    assert measurement.mode is not None
    assert measurement.mode.hz == pytest.approx(loop.hz, rel=0.0006 if noise_um == 0.010 else 0.0025)
    assert abs(measurement.mode.hz - loop.hz) < 4 * measurement.mode.hz_std
    assert abs(measurement.mode.damping - loop.damping) < 4 * measurement.mode.damping_std


def test_standard_deviations_are_those_of_repeated_measurements() -> None:
    loop = TrueLoop(595.5, 0.007, 1, 40.0)
    lines = make_grid(RATE_HZ, 0.5, 4.0, 4400.0, 595.5)
    period = excitation.fit_period(lines, *_responses(loop, lines), AMPLITUDE_UM)
    reference = excitation_sequence(period, 3, 0.0, FADE)
    errors, squares = [], []
    for seed in range(20):
        response = measure_response(lines, split_periods(lines, loop.run(reference, seed), 3))
        true = loop.open(lines.hz)
        squares.append(np.abs(response.plant * response.controller / true - 1) ** 2 / response.spread**2)
        mode = fit_light_mode(response, RATE_HZ, 595.5)
        assert mode is not None
        errors.append((mode.hz - loop.hz) / mode.hz_std)
    mean_squares = np.mean(squares, axis=0)[lines.hz < 1000]
    assert np.median(mean_squares) == pytest.approx(1.0, abs=0.25)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.45)


def test_a_margin_says_how_far_off_it_is_where_the_light_mode_decides_it() -> None:
    """A margin between the lines around the mode is as uncertain as the mode's frequency and damping."""
    loop = TrueLoop(150.0, 0.02, 0, 20.0)
    lines = make_grid(RATE_HZ, 1.0, 2.0, 4400.0, loop.hz)
    period = excitation.first_period(lines, AMPLITUDE_UM)
    for ratio in excitation.AMPLITUDE_RATIOS:
        signals = loop.run(excitation_sequence(period, 2, 0.0, FADE), seed=99)
        period = excitation.shape_period(lines, period, split_periods(lines, signals, 2), AMPLITUDE_UM, ratio)
    reference, true = excitation_sequence(period, 4, 0.0, FADE), loop.margins(lines.hz[0], lines.hz[-1])
    all_margins = [measure_loop(loop.run(reference, seed), RATE_HZ, loop.hz).margins for seed in range(20)]
    for name in ("gain_margin", "modulus_margin"):
        errors = [(getattr(margins, name).value - true[name]) / getattr(margins, name).std for margins in all_margins]
        assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.7  # 2.3 if the uncertainty of the mode is left out


def _responses(loop: TrueLoop, lines: LineGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return the responses of position and command to the reference, at the excited lines."""
    open_loop = loop.open(lines.hz)
    z = np.exp(2j * np.pi * lines.hz / RATE_HZ)
    return open_loop / (1 + open_loop), (loop.kp + loop.ki_per_s / RATE_HZ / (z - 1)) / (1 + open_loop)


def test_what_is_not_linear_is_told_from_noise() -> None:
    """Distortion repeats itself in every period: the differences between periods do not show it."""
    loop = TrueLoop(595.5, 0.02, 0, 40.0, noise_um=1e-4)
    lines = make_grid(RATE_HZ, 0.25, 8.0, 2000.0, 595.5)
    reference = excitation_sequence(excitation.fit_period(lines, *_responses(loop, lines), AMPLITUDE_UM), 2, 0.0, FADE)
    linear = measure_response(lines, split_periods(lines, loop.run(reference), 2))
    distorted = measure_response(lines, split_periods(lines, loop.run(reference, actuator=lambda v: v + 5.0 * v**2), 2))
    assert np.median(linear.spread / linear.spread_of_noise) < 2
    assert np.median(distorted.spread / distorted.spread_of_noise) > 10


def test_where_nothing_stands_out_there_is_no_light_mode() -> None:
    measurement, _ = measure(TrueLoop(595.5, 0.9, 0, 40.0), near_hz=1000.0)
    assert measurement.mode is None


@settings(max_examples=25, deadline=None)
@given(
    period_s=st.sampled_from([0.1, 0.5, 1.0]), from_hz=st.floats(40, 200), octaves=st.floats(1.5, 4),
    near=st.one_of(st.none(), st.floats(100, 800)),
)  # fmt: skip
def test_lines_are_odd_and_some_are_silent(period_s: float, from_hz: float, octaves: float, near: float | None) -> None:
    lines = make_grid(RATE_HZ, period_s, from_hz, from_hz * 2**octaves, near)
    assert np.all(lines.excited % 2 == 1)
    assert not set(lines.excited) & set(lines.silent)
    assert lines.hz[0] >= from_hz - 1e-9
    assert lines.hz[-1] <= from_hz * 2**octaves + 1e-9
    wave = lines.waveform(low_crest_amplitudes(lines, np.ones(lines.excited.size)))
    assert np.abs(lines.amplitudes(wave)) == pytest.approx(np.ones(lines.excited.size))
    assert np.abs(np.fft.rfft(wave)[lines.silent]).max() < 1e-9 * lines.samples


@pytest.mark.parametrize(("from_hz", "to_hz"), [(0.0, 100.0), (100.0, 50.0), (10.0, 4501.0), (10.0, 12.0)])
def test_a_band_without_lines_is_refused(from_hz: float, to_hz: float) -> None:
    with pytest.raises(
        ValueError, match=r"allowed: 0 < from_hz < to_hz ≤|odd multiples of 2 Hz \(1/period_s\); allowed: at least 3"
    ):
        make_grid(RATE_HZ, 0.5, from_hz, to_hz)


def test_what_is_played_begins_gently_and_ends_at_what_was_held() -> None:
    lines = make_grid(RATE_HZ, 0.5, 10.0, 1000.0)
    samples = excitation_sequence(excitation.first_period(lines, 1.0), 3, 7.0, FADE)
    assert abs(samples[0] - 7.0) < 1e-3
    assert samples[-1] == pytest.approx(7.0, abs=1e-12)
    assert (
        np.abs(np.diff(samples)).max() <= 1.01 * np.abs(np.diff(np.tile(excitation.first_period(lines, 1.0), 2))).max()
    )


def test_the_multisine_is_found_in_a_record_from_itself_alone() -> None:
    lines = make_grid(RATE_HZ, 0.5, 10.0, 1000.0)
    small = excitation_sequence(excitation.first_period(lines, 1.0), 2, 7.0, FADE)
    large = excitation_sequence(3 * excitation.first_period(lines, 1.0), 4, 7.0, FADE)
    pause = np.full(3000, 7.0)
    ramp = 7.0 + 0.001 * np.arange(20_000)
    part = find_periodic_part(np.concatenate([pause, small, pause, large, pause, ramp]))
    assert part is not None
    assert (part.samples, part.periods) == (lines.samples, 4)
    assert part.start == 3000 + small.size + 3000 + lines.samples
    assert np.array_equal(part.grid(np.concatenate([pause, small, pause, large]), RATE_HZ).excited, lines.excited)


def test_of_a_multisine_that_begins_at_once_the_first_period_is_left_out() -> None:
    lines = make_grid(RATE_HZ, 0.5, 10.0, 1000.0)
    part = find_periodic_part(
        np.concatenate([np.zeros(500), np.tile(excitation.first_period(lines, 1.0), 4), np.zeros(500)])
    )
    assert part is not None
    assert part.periods == 3
    assert part.start in (500 + lines.samples, 501 + lines.samples)


def test_a_short_move_before_the_multisine_does_not_count_as_time_to_settle() -> None:
    """The first period is excluded for settling, whatever the reference did before."""
    lines = make_grid(RATE_HZ, 0.5, 10.0, 1000.0)
    move = np.array([0.0, 0.1, 0.2, 0.3])
    pause = np.full(6000, 0.3)
    tone = 0.3 + np.tile(excitation.first_period(lines, 1.0), 4)
    part = find_periodic_part(np.concatenate([move, pause, tone, pause]))
    assert part is not None
    assert part.periods == 3
    assert abs(part.start - (move.size + pause.size + lines.samples)) <= 1


def test_the_misfit_of_a_mode_is_one_where_noise_is_all_that_is_left() -> None:
    """The misfit of only 14 lines shows whether the fitted parameters are subtracted from the degrees of freedom."""
    hz = 595.5 * np.linspace(0.9, 1.1, 14)
    z = np.exp(2j * np.pi * hz / RATE_HZ)
    pole = np.exp(2 * np.pi * 595.5 / RATE_HZ * (-0.01 + 1j * np.sqrt(1 - 0.01**2)))
    true = 0.01 / (z - pole) + 0.3 - 0.2j
    random, spread = np.random.default_rng(3), np.full(hz.size, 0.003)
    modes = []
    for _ in range(80):
        noise = np.abs(true) * spread * (random.standard_normal(14) + 1j * random.standard_normal(14)) / np.sqrt(2)
        ones = np.ones(hz.size)
        response = MeasuredResponse(hz, true + noise, ones + 0j, spread, spread, ones, 3, 0.1)
        mode = fit_light_mode(response, RATE_HZ, 595.5)
        assert mode is not None
        modes.append(mode)
    assert np.mean([mode.misfit**2 for mode in modes]) == pytest.approx(1.0, abs=0.1)
    errors = [(mode.hz - 595.5) / mode.hz_std for mode in modes]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(0.95, abs=0.2)  # a misfit below 1 leaves the deviations


def test_curves_of_a_measurement_are_those_of_its_loop_and_of_the_models() -> None:
    """S = 1/(1 + L): a relative error of L changes S by |T| times that fraction."""
    loop = TrueLoop(595.5, 0.02, 1, 40.0, noise_um=1e-3)
    lines = make_grid(RATE_HZ, 0.5, 4.0, 2000.0, 595.5)
    reference = excitation_sequence(excitation.fit_period(lines, *_responses(loop, lines), AMPLITUDE_UM), 3, 0.0, FADE)
    controller = discretise_controller(Transfer.from_zpk([], [0.0], 30.0), 1 / RATE_HZ)
    model = discrete_loop(controller, Transfer.from_zpk([], [-900.0], 900.0))
    curves = measure_loop(loop.run(reference), RATE_HZ, 595.5, model).for_json()["response"]
    open_loop, model_loop, sensitivity = (
        np.array(curves[name]) @ [1.0, 1j] for name in ("loop", "model_loop", "model_sensitivity")
    )
    lower, upper = (1 / (1 + open_loop * (1 + change)) for change in (-1e-6, 1e-6))
    slope = np.abs(upper - lower) / 2e-6 * np.abs(1 + open_loop)
    np.testing.assert_allclose(curves["sensitivity_spread"], slope * curves["loop_spread"], rtol=1e-4)
    np.testing.assert_allclose(sensitivity * (1 + model_loop), 1.0, rtol=1e-9)


@pytest.mark.parametrize("reference", [np.zeros(5000), np.arange(5000.0), np.repeat([0.0, 5.0, 0.0], 2000)])
def test_a_reference_without_a_multisine_is_refused(reference: np.ndarray) -> None:
    zero_signals = dict.fromkeys(("error_um", "command_um", "position_um"), np.zeros(reference.size))
    with pytest.raises(ValueError, match="record a multisine of several periods"):
        measure_loop({"reference_um": reference, **zero_signals}, RATE_HZ)


def test_a_period_with_a_missed_tick_is_left_out() -> None:
    loop = TrueLoop(595.5, 0.02, 0, 40.0)
    lines = make_grid(RATE_HZ, 0.25, 8.0, 2000.0, 595.5)
    signals = loop.run(excitation_sequence(excitation.first_period(lines, 1.0), 4, 0.0, FADE))
    missed_ticks = np.zeros(signals["reference_um"].size)
    missed_ticks[round(2.5 * lines.samples)] = 1.0
    assert measure_loop({**signals, "periods_missed": missed_ticks}, RATE_HZ).response.periods == 3
    missed_ticks[lines.samples :: lines.samples] = 1.0
    with pytest.raises(ValueError, match=r"periods of the multisine in the recording: \d; allowed: at least 2"):
        measure_loop({**signals, "periods_missed": missed_ticks}, RATE_HZ)


def test_what_reaches_the_command_past_the_controller_is_not_the_controllers() -> None:
    """Command taps and feedforward change the recorded error, but not the loop."""
    loop = TrueLoop(595.5, 0.02, 1, 40.0, noise_um=1e-4)
    lines = make_grid(RATE_HZ, 0.5, 4.0, 2000.0, 595.5)
    reference = excitation_sequence(excitation.fit_period(lines, *_responses(loop, lines), AMPLITUDE_UM), 3, 0.0, FADE)
    command_taps, feedforward_um = [0.3, -0.1, 0.05], 0.2 * np.roll(reference, 7)
    path_um = signal.lfilter(command_taps, 1.0, reference) + feedforward_um
    signals = loop.run(reference, bypass_um=path_um)
    with_paths = measure_loop({**signals, "feed_um": feedforward_um}, RATE_HZ, 595.5, command_taps=command_taps)
    without_paths = measure_loop(signals, RATE_HZ, 595.5)
    true = loop.open(lines.hz)
    assert np.median(np.abs(with_paths.response.plant * with_paths.response.controller / true - 1)) < 1e-3
    assert np.median(np.abs(without_paths.response.plant * without_paths.response.controller / true - 1)) > 0.1


def test_a_margin_without_a_standard_deviation_is_shown():
    assert _format_margin({"value": 2.5, "std": None}) == "2.5 ± –"
    assert _format_margin({"value": 2.5, "std": 0.125}) == "2.5 ± 0.12"
    assert _format_margin({"value": None, "std": None}) == "–"

"""Dynamics identified in closed loops with fed-back noise, compared with loops that scipy simulates; refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.dynamics.excitation import LoopExcitation, driven_input, shift_to_zero
from rtloop.design.identification.dynamics.identify_in_loop import identify_in_loop, identify_recorded_dynamics
from rtloop.design.identification.dynamics.instrumental import InstrumentedRecording, fit_whitening
from rtloop.design.identification.dynamics.nested_models import ModelSearch
from rtloop.design.identification.frequency_response import recording_response
from tests.design.coloured_loops import (
    PERIOD_S,
    TrueLoop,
    coloured_noise,
    damping_controller,
    draw_loop,
    reference_motion,
)
from tests.design.loop_bound import bounds_percent

SAMPLES = 12_000
HZ, DAMPING = 600.0, 0.01
ONE_MODE = ((HZ, DAMPING, 1.0),)


def one_mode() -> TrueLoop:
    """Return a loop whose controller damps its only mode, behind one sample of delay."""
    without_controller = TrueLoop(ONE_MODE, 1, (np.ones(1), np.ones(1)))
    return TrueLoop(ONE_MODE, 1, damping_controller(without_controller, 3.0, 20.0))


def record_loop(loop: TrueLoop, reference: np.ndarray, noise: np.ndarray, start: int = 0) -> LoopExcitation:
    """Return the excitation (reference, command, position) of a loop from tick `start` on."""
    signals = {name: signal[start:] for name, signal in loop.simulate_loop(reference, noise).items()}
    return LoopExcitation(
        "drawn", signals["command_um"], signals["position_um"], PERIOD_S, signals["reference_um"][np.newaxis]
    )


def test_order_delay_and_modes_of_a_drawn_loop_are_found() -> None:
    random = np.random.default_rng(5)
    loop = draw_loop(random)
    noise = coloured_noise(random, SAMPLES, loop.modes[0][0], 0.05)
    fit = identify_recorded_dynamics(
        record_loop(loop, reference_motion("sweep", random, SAMPLES, 6.0), noise), largest_order=6
    )
    assert (fit.model.order, fit.delay_ticks) == (4, loop.delay_ticks)
    assert fit.method.startswith("refined instrumental variables")
    for mode, (hz, damping, _) in zip(fit.modes, loop.modes, strict=True):
        assert mode.frequency_hz == pytest.approx(hz, rel=0.002)
        assert mode.damping == pytest.approx(damping, rel=0.1)
        assert abs(mode.frequency_hz - hz) < 4 * mode.frequency_std_hz
        assert abs(mode.damping - damping) < 4 * mode.damping_std
    assert fit.static_gain == pytest.approx(1.0, abs=0.02)
    assert fit.transfer.dc_gain == pytest.approx(1.0, abs=1e-12)


def test_a_loop_that_moved_before_the_recording_began_is_as_good() -> None:
    loop, random = one_mode(), np.random.default_rng(4)
    reference = 7.0 + reference_motion("steps", random, 9000, 10.0)
    run = record_loop(loop, reference, coloured_noise(random, 9000, 640.0, 0.02), start=1037)
    (mode,) = identify_in_loop(run, order=2, delay_ticks=1).modes
    assert abs(mode.frequency_hz - HZ) < 4 * mode.frequency_std_hz
    assert mode.frequency_hz == pytest.approx(HZ, rel=0.002)
    assert mode.damping == pytest.approx(DAMPING, rel=0.1)


@pytest.mark.parametrize("seed", [20, 44])
def test_standard_deviations_are_the_least_that_any_method_can_have(seed: int) -> None:
    random = np.random.default_rng(seed)
    loop = draw_loop(random)
    near_hz = 1.05 * loop.modes[0][0]
    reference, noise = reference_motion("steps", random, SAMPLES, 20.0), coloured_noise(random, SAMPLES, near_hz, 0.05)
    modes = identify_in_loop(record_loop(loop, reference, noise), order=4, delay_ticks=loop.delay_ticks).modes
    clean_command_um = loop.simulate_loop(reference, 0 * noise)["command_um"]
    bounds = bounds_percent(loop, clean_command_um, near_hz, 0.05)
    for mode, (hz, damping, _), (hz_bound, damping_bound) in zip(modes, loop.modes, bounds, strict=True):
        assert 100 * mode.frequency_std_hz / hz == pytest.approx(hz_bound, rel=0.25)
        assert 100 * mode.damping_std / damping == pytest.approx(damping_bound, rel=0.25)
        assert abs(100 * (mode.frequency_hz / hz - 1)) < 4 * hz_bound
        assert abs(100 * (mode.damping / damping - 1)) < 4 * damping_bound


def test_a_light_mode_is_found_first_beside_all_that_is_slow() -> None:
    random, samples = np.random.default_rng(23), 60_000
    loop = draw_loop(random)
    noise = coloured_noise(random, samples, loop.modes[0][0] * random.uniform(0.9, 1.1), 0.05)
    command = loop.simulate_loop(reference_motion("steps", random, samples, 20.0), 0 * noise)["command_um"]
    position = loop.simulate_plant(command, noise)["position_um"]
    run = shift_to_zero(LoopExcitation("drawn", command, position, PERIOD_S, command[np.newaxis]))
    residual_um = run.position_um - driven_input(replace(run, input=run.position_um))
    candidates = ModelSearch(InstrumentedRecording(run, run.input), fit_whitening(residual_um, 4)).grow(
        None, loop.delay_ticks, 2
    )
    assert abs(candidates[0].model.rates[0]) / 2 / np.pi == pytest.approx(loop.modes[0][0], rel=0.005)


def test_noise_is_whitened_by_the_autoregression_that_made_it() -> None:
    coefficients = np.array([1.0, -1.6, 0.9])
    noise = np.asarray(lfilter([1.0], coefficients, np.random.default_rng(1).normal(size=50_000)))
    assert fit_whitening(noise)[:3] == pytest.approx(coefficients, abs=0.02)
    assert np.count_nonzero(fit_whitening(noise, 1)) == 2


def test_what_follows_from_outside_is_the_input_without_its_noise() -> None:
    loop, random = one_mode(), np.random.default_rng(6)
    reference = reference_motion("multisine", random, SAMPLES, 3.0)
    noise = coloured_noise(random, SAMPLES, 640.0, 0.1)
    run = record_loop(loop, reference, noise)
    clean_command_um = loop.simulate_loop(reference, np.zeros(SAMPLES))["command_um"]
    driven = driven_input(run)
    assert np.corrcoef(driven, clean_command_um)[0, 1] > 0.98
    assert np.corrcoef(run.input, clean_command_um)[0, 1] < 0.9


@pytest.mark.parametrize(
    ("reference", "samples", "message"),
    [
        (np.zeros, 4000, "no external excitation: the reference is constant"),
        (np.ones, 1500, "too short: 1500 ticks; allowed in closed loop"),
        (
            lambda n: 0.3 * np.sin(2 * np.pi * 1.0 * PERIOD_S * np.arange(n)),
            4000,
            "too little external excitation|found; use another order, or a reference",
        ),
    ],
)
def test_what_is_not_enough_is_refused(reference, samples: int, message: str) -> None:
    noise = coloured_noise(np.random.default_rng(8), samples, 640.0, 0.05)
    with pytest.raises(UnsuitableData, match=message):
        identify_in_loop(record_loop(one_mode(), reference(samples), noise))


@pytest.mark.parametrize(
    ("reference", "samples", "message"),
    [
        (np.ones, 17_000, "no external excitation: the reference is constant"),
        (np.arange, 30, "the recording has 0.003 s of excitation; a frequency response needs at least 0.04 s"),
    ],
)
def test_a_frequency_response_needs_a_reference_that_moves_for_long_enough(
    reference, samples: int, message: str
) -> None:
    noise = coloured_noise(np.random.default_rng(8), samples, 640.0, 0.05)
    with pytest.raises(UnsuitableData, match=message):
        recording_response(record_loop(one_mode(), 1.0 * reference(samples), noise))


def test_a_closed_loops_order_is_chosen_on_what_is_held_out_alone() -> None:
    run = record_loop(one_mode(), np.zeros(4000), np.zeros(4000))
    with pytest.raises(ValueError, match="criterion: 'aic'"):
        identify_recorded_dynamics(run, criterion="aic")

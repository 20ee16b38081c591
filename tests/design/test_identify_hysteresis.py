"""Hysteresis identified from slow sines, compared with the plays of drawn rigs; refusals of unsuitable recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData, distinct, require_usable
from rtloop.design.identification.hysteresis.creep import describe_unexplained, is_creep_likely
from rtloop.design.identification.hysteresis.identify_from_parts import identify_from_parts
from rtloop.design.identification.hysteresis.identify_hysteresis import identify_hysteresis, unexplained_um
from rtloop.design.identification.hysteresis.thresholds import place_thresholds
from rtloop.design.identification.model_sections import feedforward_section, parse_feedforward
from rtloop.hil.stages.hysteresis import THRESHOLDS_V
from rtloop.hysteresis.loop_shape import loop_shape
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import loading_curve, model_output, play_outputs, turning_points
from tests.design.other_truths import creeping_plays, preisach
from tests.design.rigs import EQ_4, SLOW_S, draw_rig, slow_sine

DRIVES = st.lists(st.floats(-10, 10), min_size=1, max_size=60)


def make_recording(drive: np.ndarray, position: np.ndarray) -> AxisRecording:
    """Return a recording of `drive` (V) and `position` (µm) with the period SLOW_S."""
    return AxisRecording("made", SLOW_S, drive, position, position, True, "", "")


def record_model(model: PlayModel, drive: np.ndarray, offset: float = 0.0) -> AxisRecording:
    """Return a model's recording without noise or dynamics; positions were measured before the drive was written."""
    return make_recording(drive, offset + np.concatenate([[0.0], model_output(model, drive)[:-1]]))


@given(DRIVES)
def test_plays_over_a_recording_are_the_plays_sample_by_sample(drive: list[float]) -> None:
    thresholds = (0.0, 0.3, 2.0, 11.0)
    state, expected = np.zeros(4), []
    for u in drive:
        state = np.array([max(u - r, min(u + r, last)) for r, last in zip(thresholds, state, strict=True)])
        expected.append(state)
    assert np.array_equal(play_outputs(drive, thresholds), expected)


@given(DRIVES)
def test_turning_points_alternate_and_leave_no_turn_out(drive: list[float]) -> None:
    u = np.array(drive)
    turns = u[turning_points(u, 1.0)]
    steps = np.diff(turns)
    assert np.all(np.abs(steps) >= 1.0)
    assert np.all(steps[1:] * steps[:-1] < 0)


def test_chebyshev_thresholds_of_ten_volts_are_those_of_eq_4() -> None:
    assert np.abs(place_thresholds(15, 10.0, "chebyshev") - THRESHOLDS_V).max() < 0.05


def test_h_over_h_of_eq_4() -> None:
    """14.659 %, computed from the printed weights with plays stepped one by one."""
    drive = slow_sine()
    shape = loop_shape(drive, model_output(EQ_4, drive))
    assert shape.percent == pytest.approx(14.659, abs=0.03)
    assert shape.width == pytest.approx(2 * 43.01835, rel=2e-3)
    assert loading_curve(EQ_4, 10.0) == pytest.approx(43.01835, abs=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(0.3, 4.0), min_size=2, max_size=8), st.floats(-5, 5))
def test_without_noise_the_weights_come_back(slopes: list[float], offset: float) -> None:
    model = PlayModel(np.linspace(0.2, 8.0, len(slopes)), np.diff(slopes, prepend=0.0))
    fit = identify_hysteresis([record_model(model, slow_sine(), offset)], thresholds_v=model.thresholds.tolist())
    assert np.allclose(fit.model.weights, model.weights, atol=1e-8)
    assert fit.offsets_um[0] == pytest.approx(offset, abs=1e-8)
    assert fit.max_error_um < 1e-8


@pytest.mark.parametrize("seed", [101, 102])
@pytest.mark.parametrize("placement", ["chebyshev", "uniform"])
def test_a_drawn_rig_is_found_within_one_percent_of_its_range(seed: int, placement) -> None:
    rig, drive = draw_rig(seed), slow_sine()
    fit = identify_hysteresis([rig.measure(drive, SLOW_S)], placement=placement)
    truth = rig.static_um(drive)
    error = np.abs(model_output(fit.model, drive) - truth).max() / np.ptp(truth)
    print(f"seed {seed}, {placement}: error {100 * error:.3f} % of range")
    assert error <= 0.01
    assert fit.is_invertible
    assert fit.offsets_um[0] == pytest.approx(rig.options.plant.sensor.offset_um, abs=0.05)
    assert fit.model_loop.percent == pytest.approx(fit.measured_loop.percent, abs=0.5)


def test_several_recordings_share_the_weights_and_have_offsets_of_their_own() -> None:
    runs = [record_model(EQ_4, slow_sine(), 1.0), record_model(EQ_4, slow_sine(5.0), -2.0)]
    fit = identify_hysteresis(runs, thresholds_v=EQ_4.thresholds.tolist())
    assert np.allclose(fit.model.weights, EQ_4.weights, atol=1e-8)
    assert np.allclose(fit.offsets_um, (1.0, -2.0), atol=1e-8)


def test_weights_that_no_inverse_has_are_found_free_and_kept_invertible_on_request() -> None:
    model = PlayModel(np.array([0.1, 2.0, 5.0]), np.array([2.0, -2.5, 3.0]))
    runs, thresholds_v = [record_model(model, slow_sine())], model.thresholds.tolist()
    free = identify_hysteresis(runs, thresholds_v=thresholds_v, weights="free")
    assert np.allclose(free.model.weights, model.weights)
    assert not free.is_invertible
    with pytest.raises(UnsuitableData, match=r"allowed: every partial sum above 0.*invertible"):
        feedforward_section(free.model, [])
    invertible = identify_hysteresis(runs, thresholds_v=thresholds_v)
    assert np.all(np.cumsum(invertible.model.weights) >= invertible.least_slope_um_per_v * (1 - 1e-9))
    invertible.model.inverse()


def test_a_section_reads_back_to_the_same_bits() -> None:
    fit = identify_hysteresis([record_model(EQ_4, slow_sine())])
    options = parse_feedforward(feedforward_section(fit.model, ["from here"]), "made")
    assert options.thresholds_v == tuple(fit.model.thresholds.tolist())
    assert options.weights_um_per_v == tuple(fit.model.weights.tolist())


@pytest.mark.parametrize(
    ("drive", "thresholds_v", "message"),
    [
        (
            np.linspace(0, 10, 5000),
            None,
            "too little excitation: the drive turns back 0 times; allowed: at least 2 times",
        ),
        (10 * np.cos(np.linspace(0, 15, 5000)), None, r"starts at 10 V.*memory is not known"),
        (slow_sine(5.0), [0.0, 3.0, 6.0, 9.0], r"from 6 V on are never reached by a drive of at most 5 V"),
        (np.array([0.0, *[10.0, -10.0] * 60]), None, "these drives do not determine 15 weights"),
    ],
)
def test_a_drive_that_shows_too_little_is_refused(drive: np.ndarray, thresholds_v, message: str) -> None:
    with pytest.raises(UnsuitableData, match=message):
        identify_hysteresis([record_model(EQ_4, drive)], thresholds_v=thresholds_v)


@pytest.mark.parametrize("rail_um", [30.0, 42.0])
def test_clipped_readings_are_refused(rail_um: float) -> None:
    drive = slow_sine()
    position = np.clip(
        record_model(EQ_4, drive).position_um + np.random.default_rng(1).normal(0, 0.01, drive.size), -99, rail_um
    )
    with pytest.raises(UnsuitableData, match="saturated: the reading stays at"):
        require_usable("made", drive, position, position / 10)


def test_a_whole_recording_is_not_taken_for_clipped() -> None:
    drive = slow_sine()
    exact = record_model(EQ_4, drive).position_um
    require_usable("made", drive, exact, exact / 10)
    measured = draw_rig(7).measure(drive, SLOW_S).position_um
    require_usable("made", drive, measured, measured / 10)


@pytest.mark.parametrize(
    ("drive", "message"),
    [(slow_sine(0.001), "too little excitation: the position moves by"), (np.zeros(25_000), "the drive stays at 0 V")],
)
def test_a_position_within_its_noise_is_too_little(drive: np.ndarray, message: str) -> None:
    noise = np.random.default_rng(1).normal(0, 0.01, 25_000)
    with pytest.raises(UnsuitableData, match=message):
        require_usable("made", drive, noise, noise)


def test_options_that_cannot_be_are_named() -> None:
    with pytest.raises(ValueError, match="placement: 'random'; allowed: auto, chebyshev, chebyshev-from-0, uniform"):
        identify_hysteresis([make_recording(np.zeros(9), np.zeros(9))], placement="random")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="number of operators: 65; allowed: 1 to 64"):
        place_thresholds(65, 10.0, "uniform")


@pytest.mark.parametrize("dead_band_v", [0.0, 0.1])
def test_a_dead_band_is_found_where_there_is_one(dead_band_v: float) -> None:
    """The stage has other thresholds than the fit, and noise of 20 nm."""
    thresholds = dead_band_v + np.array([0.0, 0.7, 1.9, 3.6, 5.2, 7.1])
    drive = 10 * np.sin(2 * np.pi * np.arange(30_000) / 12_000)
    outputs_v, positions_um = np.zeros(thresholds.size), []
    for u in drive:
        outputs_v = np.maximum(u - thresholds, np.minimum(u + thresholds, outputs_v))
        positions_um.append(outputs_v @ [3.0, 0.5, 0.4, 0.3, 0.3, 0.2])
    position = np.append(0.0, positions_um[:-1]) + np.random.default_rng(1).normal(0, 0.02, drive.size)
    fit = identify_hysteresis([make_recording(drive, position)])
    assert (fit.model.thresholds[0] > 0) == (dead_band_v > 0)
    assert fit.placement == ("chebyshev" if dead_band_v else "chebyshev-from-0")


def test_a_wrong_sign_and_a_position_that_does_not_follow_are_named() -> None:
    """The last position belongs to another axis, which moves at twice the frequency."""
    drive = slow_sine()
    run = record_model(EQ_4, drive)
    other_axis_um = 30.0 * np.sin(4 * np.pi * 0.1 * SLOW_S * np.arange(drive.size))
    for recording, message in (
        (
            make_recording(drive, -run.position_um),
            r"the sign of drive or position is wrong: .* falls by [34]\.\d+ µm per volt of drive",
        ),
        (
            make_recording(-drive, run.position_um),
            r"the sign of drive or position is wrong: .* falls by [34]\.\d+ µm per volt of drive",
        ),
        (
            make_recording(drive, other_axis_um),
            r"no sum of play operators .* error of \d+ % of the position's range; .* up to 15 %",
        ),
    ):
        for identify in (identify_hysteresis, identify_from_parts):
            with pytest.raises(UnsuitableData, match=message):
                identify([recording])


def test_a_drift_is_no_evidence_of_a_wrong_sign() -> None:
    """Over one period, a sine and a rising line are correlated by −0.78."""
    drive = 10 * np.sin(2 * np.pi * np.linspace(0, 1, 5000))
    drifting = make_recording(drive, 0.3 * drive + np.linspace(0, 100, 5000))
    assert np.corrcoef(drifting.drive_v, drifting.position_um)[0, 1] < -0.7
    identify_from_parts([drifting])
    with pytest.raises(UnsuitableData, match="the drive turns back 1 time"):
        identify_hysteresis([drifting])


@pytest.mark.parametrize(("truth", "creeps"), [(creeping_plays, True), (preisach, False)])
def test_what_plays_leave_is_called_creep_where_a_lag_over_time_explains_it(truth, creeps: bool) -> None:
    """The creep is 0.5 µm/V with a lag of 1.5 s, in a recording of 25 s with 1 nm of noise."""
    drive = slow_sine(9.0)[::15]
    position = truth(drive) + 1e-3 * np.random.default_rng(3).normal(size=drive.size)
    run = AxisRecording("made", 15 * SLOW_S, drive, np.append(0.0, position[:-1]), position, True, "", "")
    assert unexplained_um([run], identify_hysteresis([run])) > 0
    assert describe_unexplained(1.0, creeps).startswith("the position seems to creep: ") == creeps
    assert is_creep_likely(run) == creeps


def test_a_copy_of_a_recording_is_no_independent_evidence() -> None:
    """A copy is recognised by its ticks, whatever its name and header."""
    drive_v = slow_sine()
    run = make_recording(drive_v, 2.0 * drive_v)
    second_run = replace(run, name="other", position_um=run.position_um + 1.0)
    runs, sentences = distinct([run, replace(run, name="copy", digest="another"), second_run])
    assert [kept_run.name for kept_run in runs] == [run.name, "other"]
    assert sentences == [f"copy: not used, because it is a copy of {run.name}, with the same ticks"]
    assert distinct([replace(run, name="copy")], [run])[0] == []


@pytest.mark.parametrize(("largest_um", "is_clipped"), [(2.0, False), (1.2, True)])
def test_a_coarse_sensor_is_not_taken_for_a_clipped_one(largest_um: float, is_clipped: bool) -> None:
    """At the top of a sine, a sensor with steps of 0.5 µm stays at 2 µm while the drive moves by 6 % of its span."""
    drive_v = np.sin(2 * np.pi * np.arange(8000) / 4000)
    position_um = np.minimum(0.5 * np.round(4 * drive_v), largest_um)
    if is_clipped:
        with pytest.raises(UnsuitableData, match=r"saturated: the recorded position stays at 1\.2 µm"):
            require_usable("coarse", drive_v, position_um, None)
    else:
        require_usable("coarse", drive_v, position_um, None)

"""Hysteresis from parts of loops with unknown memory, compared with sums of plays that the tests compute."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData
from rtloop.design.identification.hysteresis.identify_from_parts import identify_from_parts
from rtloop.hysteresis.unknown_memory import covered_intervals, first_determined_sample, missing_stroke
from tests.design.other_truths import (
    THRESHOLDS_V,
    WEIGHTS_UM_PER_V,
    sum_of_plays,
)
from tests.soak.parts import ALLOWED_RATIO, fit_unknown_and_known_memory, play_states, random_rig, reported_um, true_um

Array = np.ndarray[Any, Any]
SAMPLES = 300


def make_recording(drive: Array, position: Array, name: str = "made") -> AxisRecording:
    """Return a recording in which the position of a tick was measured before its drive was written."""
    shifted = np.append(position[0], position)
    return AxisRecording(name, 0.01, np.append(drive, drive[-1]), shifted, shifted, True, "", "")


def test_one_part_of_a_loop_gives_the_weights_that_it_shows() -> None:
    past = np.interp(np.arange(90), [0, 30, 60, 89], [0.0, 6.0, -3.0, 1.0])
    drive = np.interp(np.linspace(0, 1, SAMPLES), [0, 0.2, 0.6, 1], [1.0, 8.0, -8.0, 8.0])
    position = sum_of_plays(np.append(past, drive))[past.size :] - 7.0
    fit = identify_from_parts([make_recording(drive, position)], thresholds_v=THRESHOLDS_V.tolist())
    assert np.allclose(np.cumsum(fit.hysteresis.model.weights), np.cumsum(WEIGHTS_UM_PER_V), atol=0.05)
    assert fit.judgements[0].rms_um < 0.5
    assert fit.judgements[0].early_max_um < 0.01 * fit.judgements[0].range_um
    assert not fit.judgements[0].starts_from_rest
    assert fit.missing_drive == ""


@pytest.mark.parametrize("seed", range(5))
def test_within_what_was_covered_a_past_is_a_constant(seed: int) -> None:
    """The positions of one drive after two pasts differ by a constant in each covered interval, and vary outside."""
    random = np.random.default_rng(seed)
    drive = np.interp(np.linspace(0, 5, SAMPLES), range(6), [1.0, 5.0, -2.0, 7.0, -8.0, random.uniform(-7, 9)])
    pasts = [np.append(random.uniform(-10, 10, 5), drive[0]) for _ in range(2)]
    first_um, second_um = (
        play_states(np.append(past, drive), THRESHOLDS_V)[past.size :] @ WEIGHTS_UM_PER_V for past in pasts
    )
    intervals = covered_intervals(drive)
    assert intervals.max() == 3
    for number in range(intervals.max() + 1):
        assert np.ptp((first_um - second_um)[intervals == number]) < 1e-12
    assert np.ptp(first_um - second_um) > 0.1


@pytest.mark.parametrize("seed", [0, 1, 2, 103])
def test_not_knowing_the_memory_costs_little(seed: int) -> None:
    """The rigs are the first three of the soak, and rig 103: its recordings cover one of them less than it seems."""
    rig = random_rig(seed)
    fit, known_fit = fit_unknown_and_known_memory(rig)
    assert reported_um(fit, fit) <= ALLOWED_RATIO * reported_um(known_fit, fit)
    assert true_um(fit, rig, fit.stroke_v) <= ALLOWED_RATIO * true_um(known_fit, rig, fit.stroke_v)


def test_a_recording_whose_memory_is_never_known_is_not_judged() -> None:
    drive = 1.0 + 8.0 * np.sin(np.linspace(0.5, 9.0, SAMPLES))
    rising_drive = np.linspace(-5.0, 5.0, SAMPLES)
    runs = [make_recording(drive_v, sum_of_plays(drive_v)) for drive_v in (drive, rising_drive)]
    fit = identify_from_parts(runs, 8, other_runs=runs[1:])
    assert [judgement.known_share > 0 for judgement in (*fit.judgements, *fit.other_judgements)] == [True, False, False]
    assert np.isnan(fit.other_judgements[0].rms_um)
    assert not fit.other_judgements[0].is_unsettled


def test_a_drive_that_never_turns_back_is_told_what_it_misses() -> None:
    drive = np.linspace(-2.0, 8.0, SAMPLES)
    with pytest.raises(
        UnsuitableData, match=r"a stroke from 8 V to -2 V is not recorded \(the drive reached only 8 V\)"
    ):
        identify_from_parts([make_recording(drive, sum_of_plays(drive))])


def test_plays_that_no_stroke_has_shown_are_left_out_and_named() -> None:
    """The drive goes from 2 V to 8 V (sampled: 7.973 V), −8 V and −2 V; memory is known in the last stroke of 6 V."""
    drive = np.interp(np.linspace(0, 1, SAMPLES), [0, 0.25, 0.75, 1], [2.0, 8.0, -8.0, -2.0])
    run = make_recording(drive, sum_of_plays(drive) + np.random.default_rng(1).normal(0, 0.01, SAMPLES))
    fit = identify_from_parts([run], 6, "chebyshev-from-0")
    assert fit.stroke_v == pytest.approx(6.0, abs=0.1)
    assert fit.hysteresis.model.thresholds.max() < 3.0
    assert fit.missing_drive.startswith(
        "a stroke from -7.973 V to 7.973 V is not recorded (the drive reached only -2 V)"
    )
    with pytest.raises(UnsuitableData, match=r"thresholds: value is 4 V; allowed: below .* is not recorded"):
        identify_from_parts([run], thresholds_v=[0.0, 1.0, 4.0])


def test_known_stretches_by_hand() -> None:
    drive = np.array([0.0, 5.0, -5.0, 3.0, 1.0, 7.0, 6.9, 8.0])
    assert covered_intervals(drive).tolist() == [-1, -1, -1, 0, 0, -1, -1, -1]
    assert missing_stroke(drive[:4]) == (-5.0, 3.0, 5.0)
    assert [first_determined_sample(drive[:4], r) for r in (2.0, 5.0, 5.1)] == [1, 2, None]


def test_drift_stays_where_it_lessens_the_error_held_out_and_only_there() -> None:
    drive = 1.0 + 8.0 * np.sin(np.linspace(0.5, 15.0, SAMPLES))
    noise = np.random.default_rng(1).normal(0, 0.02, SAMPLES)
    for drift_um, terms in ((2.0, ("drift",)), (0.0, ())):
        run = make_recording(drive, sum_of_plays(drive) + noise + drift_um * np.linspace(-0.5, 0.5, SAMPLES))
        fit = identify_from_parts([run], 8, "chebyshev-from-0")
        assert fit.terms == terms, fit.trial_errors_um
        assert fit.judgements[0].drift_um == pytest.approx(drift_um, abs=0.1)

"""Hysteresis from parts of loops whose beginning nobody knows: against actuators of the tests' own."""

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
from tests.soak.parts import ALLOWED_RATIO, both, drawn, reported_um, stepped, true_um

Array = np.ndarray[Any, Any]
SAMPLES = 300


def run_of(drive: Array, position: Array, name: str = "made") -> AxisRecording:
    """A tick's position was measured before its drive was written."""
    shifted = np.append(position[0], position)
    return AxisRecording(name, 0.01, np.append(drive, drive[-1]), shifted, shifted, True, "", "")


def test_one_part_of_a_loop_gives_the_weights_that_it_shows() -> None:
    past = np.interp(np.arange(90), [0, 30, 60, 89], [0.0, 6.0, -3.0, 1.0])
    drive = np.interp(np.linspace(0, 1, SAMPLES), [0, 0.2, 0.6, 1], [1.0, 8.0, -8.0, 8.0])
    position = sum_of_plays(np.append(past, drive))[past.size :] - 7.0
    found = identify_from_parts([run_of(drive, position)], thresholds_v=THRESHOLDS_V.tolist())
    assert np.allclose(np.cumsum(found.hysteresis.model.weights), np.cumsum(WEIGHTS_UM_PER_V), atol=0.05)
    assert found.judgements[0].rms_um < 0.5
    assert found.judgements[0].early_max_um < 0.01 * found.judgements[0].range_um
    assert not found.judgements[0].starts_from_rest
    assert found.missing_drive == ""


@pytest.mark.parametrize("seed", range(5))
def test_within_what_was_covered_a_past_is_a_constant(seed: int) -> None:
    """Two pasts, one drive: what they differ by stands still in every stretch, and moves elsewhere."""
    random = np.random.default_rng(seed)
    drive = np.interp(np.linspace(0, 5, SAMPLES), range(6), [1.0, 5.0, -2.0, 7.0, -8.0, random.uniform(-7, 9)])
    pasts = [np.append(random.uniform(-10, 10, 5), drive[0]) for _ in range(2)]
    one, other = (stepped(np.append(past, drive), THRESHOLDS_V)[past.size :] @ WEIGHTS_UM_PER_V for past in pasts)
    stretches = covered_intervals(drive)
    assert stretches.max() == 3
    for number in range(stretches.max() + 1):
        assert np.ptp((one - other)[stretches == number]) < 1e-12
    assert np.ptp(one - other) > 0.1


@pytest.mark.parametrize("seed", [0, 1, 2, 103])
def test_not_knowing_the_memory_costs_little(seed: int) -> None:
    """Of the soak's rigs the first three, and one of whose recordings the others show less than they seem to."""
    rig = drawn(seed)
    found, known = both(rig)
    assert reported_um(found, found) <= ALLOWED_RATIO * reported_um(known, found)
    assert true_um(found, rig, found.stroke_v) <= ALLOWED_RATIO * true_um(known, rig, found.stroke_v)


def test_a_recording_whose_memory_is_never_known_is_not_judged() -> None:
    drive = 1.0 + 8.0 * np.sin(np.linspace(0.5, 9.0, SAMPLES))
    straight = np.linspace(-5.0, 5.0, SAMPLES)
    runs = [run_of(one, sum_of_plays(one)) for one in (drive, straight)]
    found = identify_from_parts(runs, 8, other_runs=runs[1:])
    assert [one.known_share > 0 for one in (*found.judgements, *found.other_judgements)] == [True, False, False]
    assert np.isnan(found.other_judgements[0].rms_um)
    assert not found.other_judgements[0].is_unsettled


def test_a_drive_that_never_turns_back_is_told_what_it_misses() -> None:
    drive = np.linspace(-2.0, 8.0, SAMPLES)
    with pytest.raises(
        UnsuitableData, match=r"a stroke from 8 V to -2 V is not recorded \(the drive reached only 8 V\)"
    ):
        identify_from_parts([run_of(drive, sum_of_plays(drive))])


def test_plays_that_no_stroke_has_shown_are_left_out_and_named() -> None:
    """From 2 V to 8 V (7.973 V are sampled), to −8 V, back to −2 V: the last stroke has 6 V, all of it known."""
    drive = np.interp(np.linspace(0, 1, SAMPLES), [0, 0.25, 0.75, 1], [2.0, 8.0, -8.0, -2.0])
    run = run_of(drive, sum_of_plays(drive) + np.random.default_rng(1).normal(0, 0.01, SAMPLES))
    found = identify_from_parts([run], 6, "chebyshev-from-0")
    assert found.stroke_v == pytest.approx(6.0, abs=0.1)
    assert found.hysteresis.model.thresholds.max() < 3.0
    assert found.missing_drive.startswith(
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
        run = run_of(drive, sum_of_plays(drive) + noise + drift_um * np.linspace(-0.5, 0.5, SAMPLES))
        found = identify_from_parts([run], 8, "chebyshev-from-0")
        assert found.terms == terms, found.trial_errors_um
        assert found.judgements[0].drift_um == pytest.approx(drift_um, abs=0.1)

"""Hysteresis from parts of loops whose beginning nobody knows: against actuators of the tests' own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from rtloop.design.identification.hysteresis.identify_from_parts import identify_from_parts
from rtloop.design.identification.hysteresis.judgement import together
from rtloop.design.identification.measured import Measured, UnsuitableData
from rtloop.hysteresis.unknown_memory import known_from, known_stroke_v, missing_stroke
from rtloop.laws.shipped.play_model import PlayModel
from tests.design.other_truths import (
    THRESHOLDS_V,
    WEIGHTS_UM_PER_V,
    bouc_wen,
    creeping_plays,
    part_of_a_drive,
    preisach,
    stepped_plays,
    sum_of_plays,
)

Array = np.ndarray[Any, Any]
SAMPLES = 300


def run_of(drive: Array, position: Array, name: str = "made") -> Measured:
    """A tick's position was measured before its drive was written."""
    shifted = np.append(position[0], position)
    return Measured(name, 0.01, np.append(drive, drive[-1]), shifted, shifted, True, "", "")


def of_strokes(random: np.random.Generator) -> tuple[Array, Array]:
    """A past and a drive, in V, that turns back two dozen times."""
    return part_of_a_drive(random, 2 * SAMPLES, 24)


def of_sines(random: np.random.Generator) -> tuple[Array, Array]:
    """A past and a drive, in V: three periods, less and less of them."""
    angle, sizes = random.uniform(0, 2 * np.pi), np.interp(np.arange(2 * SAMPLES), [0, 240, 600], [9.0, 9.0, 3.6])
    return 9 * np.sin(angle + np.linspace(-8, 0, SAMPLES)), sizes * np.sin(angle + np.linspace(0, 20, 2 * SAMPLES))


def recorded(truth: Any, seed: int, drive_of: Any = of_strokes) -> Measured:
    """A drive after a past that is not recorded, with an offset and 20 nm of noise."""
    random = np.random.default_rng(seed)
    past, drive = drive_of(random)
    clean = truth(np.concatenate([past, drive]))[past.size :] + random.uniform(-3, 3)
    return run_of(drive, clean + random.normal(0, 0.02, drive.size), f"part {seed}")


def true_um(truth: Any, model: PlayModel, seeds: Sequence[int], drive_of: Any = of_strokes) -> float:
    """rms that a model, whose plays are stepped here, errs by on drives of the same kind, offset aside."""
    squares = []
    for seed in seeds:
        past, drive = drive_of(np.random.default_rng(seed))
        whole = np.concatenate([past, drive])
        error = truth(whole) - stepped_plays(whole, model.thresholds, model.weights)
        squares.append(np.var(error[past.size :]))
    return float(np.sqrt(np.mean(squares)))


def test_one_part_of_a_loop_gives_the_weights_that_it_shows() -> None:
    past = np.interp(np.arange(90), [0, 30, 60, 89], [0.0, 6.0, -3.0, 1.0])
    drive = np.interp(np.linspace(0, 1, SAMPLES), [0, 0.2, 0.6, 1], [1.0, 8.0, -8.0, 8.0])
    position = sum_of_plays(np.append(past, drive))[past.size :] - 7.0
    found = identify_from_parts([run_of(drive, position)], thresholds_v=THRESHOLDS_V.tolist())
    assert np.allclose(np.cumsum(found.shape.model.weights), np.cumsum(WEIGHTS_UM_PER_V), atol=0.05)
    assert found.judgements[0].rms_um < 0.5
    assert not found.judgements[0].from_rest
    assert found.missing == ""


def test_a_drive_that_never_turns_back_is_told_what_it_misses() -> None:
    drive = np.linspace(-2.0, 8.0, SAMPLES)
    with pytest.raises(UnsuitableData, match=r"missing: the drive from 8 V on to -2 V, in one stroke from 8 V"):
        identify_from_parts([run_of(drive, sum_of_plays(drive))])


def test_plays_that_no_stroke_has_shown_are_left_out_and_named() -> None:
    """From 2 V to 8 V (7.973 V are sampled), to −8 V, back to −2 V: the last stroke has 6 V, all of it known."""
    drive = np.interp(np.linspace(0, 1, SAMPLES), [0, 0.25, 0.75, 1], [2.0, 8.0, -8.0, -2.0])
    run = run_of(drive, sum_of_plays(drive) + np.random.default_rng(1).normal(0, 0.01, SAMPLES))
    found = identify_from_parts([run], 6, "chebyshev-from-0")
    assert found.stroke_v == pytest.approx(6.0, abs=0.1)
    assert found.shape.model.thresholds.max() < 3.0
    assert found.missing.startswith("missing: the drive from -2 V on to 7.973 V, in one stroke from -7.973 V")
    with pytest.raises(UnsuitableData, match=r"thresholds from 4 V on cannot be told.*missing"):
        identify_from_parts([run], thresholds_v=[0.0, 1.0, 4.0])


def test_known_strokes_by_hand() -> None:
    drive = np.array([0.0, 5.0, -5.0, 3.0])
    assert known_stroke_v(drive) == 8.0
    assert known_stroke_v(np.array([0.0, 5.0, -5.0])) == 5.0
    assert missing_stroke(drive) == (-5.0, 3.0, 5.0)
    assert [known_from(drive, r) for r in (2.0, 5.0, 5.1)] == [1, 2, None]


def test_drift_stays_where_it_lessens_the_error_held_out_and_only_there() -> None:
    drive = 1.0 + 8.0 * np.sin(np.linspace(0.5, 15.0, SAMPLES))
    noise = np.random.default_rng(1).normal(0, 0.02, SAMPLES)
    for drift_um, terms in ((2.0, ("drift",)), (0.0, ())):
        run = run_of(drive, sum_of_plays(drive) + noise + drift_um * np.linspace(-0.5, 0.5, SAMPLES))
        found = identify_from_parts([run], 8, "chebyshev-from-0")
        assert found.terms == terms, found.tried
        assert found.judgements[0].drift_um == pytest.approx(drift_um, abs=0.1)


@pytest.mark.parametrize(
    ("truth", "drive_of", "creeps"),
    [(bouc_wen, of_strokes, False), (preisach, of_strokes, False), (creeping_plays, of_sines, True)],
)
def test_the_error_of_what_is_written_is_reported(truth: Any, drive_of: Any, creeps: bool) -> None:
    """No sums of plays: rms as held out against that of the model on drives that come later.

    What fades with the drive's path is not taken for creep.
    """
    found = identify_from_parts([recorded(truth, seed, drive_of) for seed in range(50, 53)], 5, "chebyshev-from-0")
    assert ("creep" in found.terms) == creeps, found.tried
    reported = together([one.as_written_rms_um or np.nan for one in found.judgements])
    true = true_um(truth, found.shape.model, range(100, 108), drive_of)
    print(f"{truth.__name__}: reported {reported.rms_um:.4f} ± {reported.std_um:.4f}, true {true:.4f} µm")
    assert true > 0.3
    assert reported.rms_um == pytest.approx(true, rel=0.2)

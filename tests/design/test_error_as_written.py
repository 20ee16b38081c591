"""Actuators that are no sums of plays: the error that is reported of the plays as written, beside the true one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from rtloop.design.identification.axis_recording import AxisRecording
from rtloop.design.identification.hysteresis.identify_from_parts import identify_from_parts
from rtloop.design.identification.hysteresis.judgement import combine_errors
from rtloop.hysteresis.play_model import PlayModel
from tests.design.other_truths import bouc_wen, creeping_plays, part_of_a_drive, preisach, stepped_plays

Array = np.ndarray[Any, Any]
SAMPLES = 300


def of_strokes(random: np.random.Generator) -> tuple[Array, Array]:
    """A past and a drive, in V, that turns back two dozen times."""
    return part_of_a_drive(random, 2 * SAMPLES, 24)


def of_sines(random: np.random.Generator) -> tuple[Array, Array]:
    """A past and a drive, in V: three periods, less and less of them."""
    angle, sizes = random.uniform(0, 2 * np.pi), np.interp(np.arange(2 * SAMPLES), [0, 240, 600], [9.0, 9.0, 3.6])
    return 9 * np.sin(angle + np.linspace(-8, 0, SAMPLES)), sizes * np.sin(angle + np.linspace(0, 20, 2 * SAMPLES))


def recorded(truth: Any, seed: int, drive_of: Any = of_strokes) -> AxisRecording:
    """A drive after a past that is not recorded, with an offset and 20 nm of noise."""
    random = np.random.default_rng(seed)
    past, drive = drive_of(random)
    clean = truth(np.concatenate([past, drive]))[past.size :] + random.uniform(-3, 3)
    position = clean + random.normal(0, 0.02, drive.size)
    shifted = np.append(position[0], position)  # a tick's position was measured before its drive was written
    return AxisRecording(f"part {seed}", 0.01, np.append(drive, drive[-1]), shifted, shifted, True, "", "")


def true_um(truth: Any, model: PlayModel, seeds: Sequence[int], drive_of: Any = of_strokes) -> float:
    """rms that a model, whose plays are stepped here, errs by on drives of the same kind, offset aside."""
    squares = []
    for seed in seeds:
        past, drive = drive_of(np.random.default_rng(seed))
        whole = np.concatenate([past, drive])
        error = truth(whole) - stepped_plays(whole, model.thresholds, model.weights)
        squares.append(np.var(error[past.size :]))
    return float(np.sqrt(np.mean(squares)))


@pytest.mark.parametrize(
    ("truth", "drive_of", "creeps"),
    [(bouc_wen, of_strokes, False), (preisach, of_strokes, False), (creeping_plays, of_sines, True)],
)
def test_the_error_of_what_is_written_is_reported(truth: Any, drive_of: Any, creeps: bool) -> None:
    """No sums of plays: rms as held out against that of the model on drives that come later.

    What fades with the drive's path is not taken for creep.
    """
    found = identify_from_parts([recorded(truth, seed, drive_of) for seed in range(50, 53)], 5, "chebyshev-from-0")
    assert ("creep" in found.terms) == creeps, found.trial_errors_um
    reported = combine_errors([one.rms_of_plays_um for one in found.judgements])
    true = true_um(truth, found.hysteresis.model, range(100, 108), drive_of)
    print(f"{truth.__name__}: reported {reported.rms_um:.4f} ± {reported.std_um:.4f}, true {true:.4f} µm")
    assert true > 0.3
    assert reported.rms_um == pytest.approx(true, rel=0.2)

"""Reported error of a play model, against its true error on actuators that are no sums of plays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from rtloop.design.identification.axis_recording import AxisRecording
from rtloop.design.identification.hysteresis.identify_from_parts import identify_from_parts
from rtloop.design.identification.hysteresis.judgement import combine_errors
from rtloop.hysteresis.play_model import PlayModel
from tests.design.other_truths import bouc_wen, creeping_plays, preisach, random_drive, step_plays

Array = np.ndarray[Any, Any]
SAMPLES = 300


def stroke_drive(random: np.random.Generator) -> tuple[Array, Array]:
    """Return a past and a drive (V); the drive turns back about two dozen times."""
    return random_drive(random, 2 * SAMPLES, 24)


def sine_drive(random: np.random.Generator) -> tuple[Array, Array]:
    """Return a past and a drive (V): sines of 9 V, about three periods in the drive, falling to 3.6 V."""
    angle, sizes = random.uniform(0, 2 * np.pi), np.interp(np.arange(2 * SAMPLES), [0, 240, 600], [9.0, 9.0, 3.6])
    return 9 * np.sin(angle + np.linspace(-8, 0, SAMPLES)), sizes * np.sin(angle + np.linspace(0, 20, 2 * SAMPLES))


def record_part(truth: Any, seed: int, make_drive: Any = stroke_drive) -> AxisRecording:
    """Return a recording of the drive alone, after an unrecorded past, with an offset and 20 nm of noise."""
    random = np.random.default_rng(seed)
    past, drive = make_drive(random)
    clean = truth(np.concatenate([past, drive]))[past.size :] + random.uniform(-3, 3)
    position = clean + random.normal(0, 0.02, drive.size)
    shifted = np.append(position[0], position)  # a tick's position was measured before its drive was written
    return AxisRecording(f"part {seed}", 0.01, np.append(drive, drive[-1]), shifted, shifted, True, "", "")


def true_error_um(truth: Any, model: PlayModel, seeds: Sequence[int], make_drive: Any = stroke_drive) -> float:
    """Return the rms error (µm) of a model, stepped play by play, on drives of the same kind, without the offset."""
    squares = []
    for seed in seeds:
        past, drive = make_drive(np.random.default_rng(seed))
        drive_with_past = np.concatenate([past, drive])
        error = truth(drive_with_past) - step_plays(drive_with_past, model.thresholds, model.weights)
        squares.append(np.var(error[past.size :]))
    return float(np.sqrt(np.mean(squares)))


@pytest.mark.parametrize(
    ("truth", "make_drive", "creeps"),
    [(bouc_wen, stroke_drive, False), (preisach, stroke_drive, False), (creeping_plays, sine_drive, True)],
)
def test_the_error_of_what_is_written_is_reported(truth: Any, make_drive: Any, creeps: bool) -> None:
    """The reported rms of held-out parts agrees with the model's true rms on later drives.

    An effect that fades with the drive's path is not identified as creep.
    """
    fit = identify_from_parts([record_part(truth, seed, make_drive) for seed in range(50, 53)], 5, "chebyshev-from-0")
    assert ("creep" in fit.terms) == creeps, fit.trial_errors_um
    reported = combine_errors([judgement.rms_of_plays_um for judgement in fit.judgements])
    true_rms_um = true_error_um(truth, fit.hysteresis.model, range(100, 108), make_drive)
    print(f"{truth.__name__}: reported {reported.rms_um:.4f} ± {reported.std_um:.4f}, true {true_rms_um:.4f} µm")
    assert true_rms_um > 0.3
    assert reported.rms_um == pytest.approx(true_rms_um, rel=0.2)

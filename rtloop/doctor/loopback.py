"""What a wire from an output to an input shows: gain, offset, noise and delay of the pair, from a recorded staircase.

    reading[k] = gain · drive[k − delay] + offset + noise

Gain, offset and noise come from the settled part of each step, so that neither slew nor settling bends them; the delay
is the whole number of ticks at which the line above leaves the least.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Signal = npt.NDArray[np.float64]
LEAST_CORRELATION = 0.5
"""Below it the reading does not follow the output, and has no delay."""


@dataclass(frozen=True)
class Pair:
    """An output and an input: `noise_v` is rms, `delay_ticks` None where the reading does not follow."""

    gain: float
    offset_v: float
    noise_v: float
    delay_ticks: int | None


def measure(drive_v: Signal, reading_v: Signal, settling_ticks: int) -> Pair:
    """The pair's numbers; a sample counts as settled once the drive stood still for `settling_ticks`.

    Raises ValueError where the drive never stood still at two different values.
    """
    changes = np.flatnonzero(np.diff(drive_v)) + 1
    starts = np.concatenate([[0], changes])
    hold = np.searchsorted(changes, np.arange(drive_v.size), side="right")
    settled = np.arange(drive_v.size) - starts[hold] >= settling_ticks
    if np.unique(drive_v[settled]).size < 2:
        raise ValueError("the drive never stood still at two different values")
    gain, offset_v = np.polyfit(drive_v[settled], reading_v[settled], 1)
    _, level = np.unique(hold[settled], return_inverse=True)
    means = np.bincount(level, reading_v[settled]) / np.bincount(level)
    spread = reading_v[settled] - means[level]
    freedom = max(spread.size - means.size, 1)
    noise_v = float(np.sqrt(spread @ spread / freedom))
    return Pair(float(gain), float(offset_v), noise_v, _delay(drive_v, reading_v, settling_ticks))


def _delay(drive_v: Signal, reading_v: Signal, longest: int) -> int | None:
    """The lag up to `longest` at which drive and reading are most alike, whatever their scales and signs."""
    if not np.ptp(reading_v):
        return None
    size = drive_v.size - longest
    likeness = [abs(np.corrcoef(drive_v[:size], reading_v[lag : lag + size])[0, 1]) for lag in range(longest + 1)]
    best = int(np.argmax(likeness))
    return best if likeness[best] >= LEAST_CORRELATION else None

"""How a loop is excited within a stated motion: a first multisine that is small, and one shaped by what it showed.

The second one moves x equally at all lines as far as the command allows that; its phases keep the peak of x low, and
its size follows from the response of the first.
"""

from __future__ import annotations

import numpy as np

from rtloop.analysis.measured.multisine import Grid, flattened
from rtloop.analysis.measured.response import Signals
from rtloop.hil.modal import Complex, Real

FIRST_PART = 0.2
"""Of the stated amplitude: the peak of the first reference, so that a loop may amplify it fivefold."""
AIM = 0.85
"""Part of the stated amplitude that the second one is to reach."""
LARGEST_COMMAND, LARGEST_REFERENCE = 3.0, 10.0
"""Peaks over the stated amplitude that the second one may ask of the command, and that it may have itself."""
CERTAIN = 3.0
"""A line's response counts as no smaller than so many of its standard deviations."""


def first(grid: Grid, amplitude_um: float) -> Real:
    """A period (samples,) of equal lines, small."""
    wave = grid.waveform(flattened(grid, np.ones(grid.excited.size)))
    return wave * (FIRST_PART * amplitude_um / np.abs(wave).max())


def second(grid: Grid, played: Real, seen: Signals, amplitude_um: float) -> Real:
    """A period (samples,) for an added motion of AIM times `amplitude_um`, by what the first one, `played`, showed."""
    reference = grid.amplitudes(played)
    moved, least = _answer(grid, seen.position, reference)
    asked, _ = _answer(grid, seen.command, reference)
    sizes = 1 / np.maximum(np.abs(moved), least)
    sizes = np.minimum(sizes, LARGEST_COMMAND / np.maximum(np.abs(asked), 1e-12))
    sizes = np.minimum(sizes, LARGEST_REFERENCE * np.median(sizes))
    turned = np.exp(-1j * np.angle(moved))
    lines = turned * flattened(grid, sizes * np.abs(moved)) / np.abs(moved)
    peaks = [_peak(grid, lines * one) for one in (moved, asked, 1.0)]
    allowed = (AIM, LARGEST_COMMAND, LARGEST_REFERENCE)
    return grid.waveform(lines) * min(amplitude_um * most / peak for most, peak in zip(allowed, peaks, strict=True))


def _answer(grid: Grid, signal: Real, reference: Complex) -> tuple[Complex, float]:
    """Of a signal (periods, samples) per reference, and the least that stands out of noise, at a typical line."""
    period = signal.mean(axis=0)
    noise = np.sqrt(np.mean(np.abs(np.fft.rfft(period)[grid.silent] * 2 / grid.samples) ** 2))
    answer = grid.amplitudes(period) / reference
    return answer, float(CERTAIN * noise / np.median(np.abs(reference)))


def _peak(grid: Grid, lines: Complex) -> float:
    return float(np.abs(grid.waveform(lines)).max())

"""How a loop is excited within a stated motion: a first multisine that is small, and others shaped by what was seen.

Those have larger lines where x answers less, as far as the command allows that; their phases keep the peak of x low,
and their size follows from the response to the one before. A loop with a dead band answers the more the further it
moves: so it is approached in steps.
"""

from __future__ import annotations

import numpy as np

from rtloop.analysis.measured.multisine import LineGrid, low_crest_amplitudes
from rtloop.analysis.measured.response import PeriodSignals
from rtloop.foundation.arrays import Complex, Real

FIRST_AMPLITUDE_RATIO = 0.2
"""Of the stated amplitude: the peak of the first reference, so that a loop may amplify it fivefold."""
AMPLITUDE_RATIOS = (0.35, 0.75)
"""Parts of the stated amplitude that those behind it are to reach in turn."""
LARGEST_COMMAND, LARGEST_REFERENCE = 3.0, 10.0
"""Peaks over the stated amplitude that they may ask of the command, and that they may have themselves."""
SHAPING_EXPONENT = 0.5
"""Between references that are equal at all lines (0) and motions that are (1): most is wanted where |L| is near 1."""
CERTAIN_DEVIATIONS = 3.0
"""A line's response counts as no smaller than so many of its standard deviations."""


def first_period(grid: LineGrid, amplitude_um: float) -> Real:
    """A period (samples,) of equal lines, small."""
    wave = grid.waveform(low_crest_amplitudes(grid, np.ones(grid.excited.size)))
    return wave * (FIRST_AMPLITUDE_RATIO * amplitude_um / np.abs(wave).max())


def shape_period(
    grid: LineGrid, previous_period: Real, signals: PeriodSignals, amplitude_um: float, aim: float
) -> Real:
    """A period (samples,) for an added motion of `aim` times `amplitude_um`, by what the one `played` before showed."""
    reference = grid.amplitudes(previous_period)
    position_response, min_response = _signal_response(grid, signals.position, reference)
    command_response, _ = _signal_response(grid, signals.command, reference)
    return fit_period(grid, position_response, command_response, amplitude_um, aim, min_response)


def fit_period(
    grid: LineGrid,
    position_response: Complex,
    command_response: Complex,
    amplitude_um: float,
    aim: float = AMPLITUDE_RATIOS[-1],
    min_response: float | Real = 1e-9,
) -> Real:
    """A period (samples,) for an added motion of `aim` times `amplitude_um`, where a reference gives `moved` of
    position and `asked` of command at the lines (excited,), and less than `least` of position is not to be told."""
    sizes = np.maximum(np.abs(position_response), min_response) ** -SHAPING_EXPONENT
    sizes = np.minimum(sizes, LARGEST_COMMAND / np.maximum(np.abs(command_response), 1e-12))
    sizes = np.minimum(sizes, LARGEST_REFERENCE * np.median(sizes))
    flat = low_crest_amplitudes(grid, sizes * np.maximum(np.abs(position_response), 1e-12))
    lines = sizes * np.exp(1j * (np.angle(flat) - np.angle(position_response)))
    peaks = [
        _peak_value(grid, lines * response)
        for response in (position_response, command_response, np.ones_like(position_response))
    ]
    peak_ratios = (aim, LARGEST_COMMAND, LARGEST_REFERENCE)
    return grid.waveform(lines) * min(
        amplitude_um * peak_ratio / peak for peak_ratio, peak in zip(peak_ratios, peaks, strict=True)
    )


def _signal_response(grid: LineGrid, signal: Real, reference: Complex) -> tuple[Complex, Real]:
    """Of a signal (periods, samples) per reference, and the least that stands out of noise, (excited,)."""
    period = signal.mean(axis=0)
    noise = np.sqrt(np.mean(np.abs(np.fft.rfft(period)[grid.silent] * 2 / grid.samples) ** 2))
    return grid.amplitudes(period) / reference, CERTAIN_DEVIATIONS * noise / np.abs(reference)


def _peak_value(grid: LineGrid, lines: Complex) -> float:
    return float(np.abs(grid.waveform(lines)).max())

"""Excitation of a loop within a stated motion: a small multisine first, then others shaped by the last response.

Shaped ones have larger lines where x answers less, as far as the command allows; their phases keep the peak of x low,
and their size follows from the response to the one before. A loop with a dead band answers more the further it moves:
the stated motion is approached in steps.
"""

from __future__ import annotations

import numpy as np

from rtloop.analysis.measured.multisine import LineGrid, low_crest_amplitudes
from rtloop.analysis.measured.response import PeriodSignals
from rtloop.foundation.arrays import Complex, Real

FIRST_AMPLITUDE_RATIO = 0.2
"""Peak of the first reference over the stated amplitude: a loop may amplify it fivefold."""
REST_MARGIN = 1.2
"""Factor on the position's motion at rest, which is allowed in addition to the stated amplitude."""
AMPLITUDE_RATIOS = (0.35, 0.75)
"""Motions, over the stated amplitude, that the following references aim at in turn."""
LARGEST_COMMAND, LARGEST_REFERENCE = 3.0, 10.0
"""Limits, over the stated amplitude, for the peaks of the command and of the reference itself."""
SHAPING_EXPONENT = 0.5
"""0: references equal at all lines; 1: motions equal at all lines. In between, lines are
largest where |L| is near 1."""
CERTAIN_DEVIATIONS = 3.0
"""A line's response counts as at least so many of its standard deviations."""


def first_period(grid: LineGrid, amplitude_um: float) -> Real:
    """Return one period (samples,) of the first reference, µm, with equal amplitudes at all lines.

    Its peak is FIRST_AMPLITUDE_RATIO times `amplitude_um`.
    """
    wave = grid.waveform(low_crest_amplitudes(grid, np.ones(grid.excited.size)))
    return wave * (FIRST_AMPLITUDE_RATIO * amplitude_um / np.abs(wave).max())


def shape_period(
    grid: LineGrid, previous_period: Real, signals: PeriodSignals, amplitude_um: float, aim: float
) -> Real:
    """Return a period (samples,) of the reference, µm, for a motion of `aim` times `amplitude_um`, within the limits of
    `fit_period`.

    Its lines are shaped by the loop's response to `previous_period` (samples,) of the reference, of which `signals` are
    the recorded periods.
    """
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
    """Return a period (samples,) of the reference, µm, for a peak of the position of `aim` times `amplitude_um`.

    The peak is smaller if command or reference would exceed LARGEST_COMMAND or LARGEST_REFERENCE times `amplitude_um`.
    Responses from the reference to position and command are at the lines (excited,); position responses below
    `min_response` count as equal to it.
    """
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
    """Return a signal's response (excited,) per reference, and the least response that exceeds noise, (excited,).

    `signal` is (periods, samples), `reference` the complex amplitudes (excited,).
    """
    period = signal.mean(axis=0)
    noise = np.sqrt(np.mean(np.abs(np.fft.rfft(period)[grid.silent] * 2 / grid.samples) ** 2))
    return grid.amplitudes(period) / reference, CERTAIN_DEVIATIONS * noise / np.abs(reference)


def _peak_value(grid: LineGrid, lines: Complex) -> float:
    """Return the largest magnitude of the waveform with the complex amplitudes `lines` (excited,)."""
    return float(np.abs(grid.waveform(lines)).max())

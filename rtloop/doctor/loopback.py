"""Gain, offset, noise and delay of a wire from an output to an input, from a recorded staircase.

    reading[k] = gain · drive[k − delay] + offset + noise

Gain, offset and noise come from the settled part of each step, so that neither slew nor settling bends them. The delay
is the whole number of ticks at which drive and reading correlate most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtloop.foundation.arrays import Real

MIN_CORRELATION = 0.5
"""With a smaller correlation the reading does not follow the output, and no delay is reported."""


@dataclass(frozen=True)
class ChannelPair:
    """Figures of an output and an input: gain in V/V, rms noise; `delay_ticks` is None if the input does not follow."""

    gain: float
    offset_v: float
    noise_v: float
    delay_ticks: int | None


def measure_pair(drive_v: Real, reading_v: Real, settling_ticks: int) -> ChannelPair:
    """Return gain, offset, noise and delay of a wire from its recorded drive and reading, each (ticks,) in V.

    Gain, offset and noise are of the ticks at which the drive has stood still for `settling_ticks`; the delay is found
    from 0 to `settling_ticks`, in all ticks. Raises ValueError if the drive did not stand still so long at two
    different values.
    """
    changes = np.flatnonzero(np.diff(drive_v)) + 1
    starts = np.concatenate([[0], changes])
    step_index = np.searchsorted(changes, np.arange(drive_v.size), side="right")
    is_settled = np.arange(drive_v.size) - starts[step_index] >= settling_ticks
    if np.unique(drive_v[is_settled]).size < 2:
        raise ValueError(
            "the drive did not rest at two different voltages, which the gain needs; use a larger --amplitude"
        )
    gain, offset_v = np.polyfit(drive_v[is_settled], reading_v[is_settled], 1)
    _, level = np.unique(step_index[is_settled], return_inverse=True)
    means = np.bincount(level, reading_v[is_settled]) / np.bincount(level)
    residuals = reading_v[is_settled] - means[level]
    degrees_of_freedom = max(residuals.size - means.size, 1)
    noise_v = float(np.sqrt(residuals @ residuals / degrees_of_freedom))
    return ChannelPair(float(gain), float(offset_v), noise_v, _find_delay(drive_v, reading_v, settling_ticks))


def _find_delay(drive_v: Real, reading_v: Real, max_lag: int) -> int | None:
    """Return the lag of the reading, 0 … `max_lag` ticks, with the largest |correlation| of drive and reading.

    None if this correlation is below MIN_CORRELATION, and for a constant reading.
    """
    if not np.ptp(reading_v):
        return None
    size = drive_v.size - max_lag
    correlations = [abs(np.corrcoef(drive_v[:size], reading_v[lag : lag + size])[0, 1]) for lag in range(max_lag + 1)]
    best_lag = int(np.argmax(correlations))
    return best_lag if correlations[best_lag] >= MIN_CORRELATION else None

"""Search for a multisine in a recorded reference, from the record alone: where it repeats itself to the last bit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.analysis.measured.multisine import LineGrid
from rtloop.foundation.arrays import Real

LEAST_SAMPLES, COMPARED_SAMPLES = 64, 32
"""Least samples of a period, and samples compared first in the search for a repetition."""
STILL_SAMPLES = 8
"""Number of equal samples in a row that ends a moving range."""
LEAST_LINES = 3
SETTLING_PART = 0.25
"""Fraction of a period. With less motion before the repetition, its first period is left to settle."""
EXCITED_PART = 1e-6
"""Size, over the largest line, above which a line counts as excited."""


class PeriodicPart(NamedTuple):
    """Whole periods of a reference after one to settle: `periods` of `samples` ticks each, from tick `start` on."""

    start: int
    samples: int
    periods: int

    @property
    def tick_slice(self) -> slice:
        """Slice of the ticks of all periods."""
        return slice(self.start, self.start + self.samples * self.periods)

    def reshape_periods(self, signal: Real) -> Real:
        """Return the periods of a signal (ticks,) as (periods, samples)."""
        return signal[self.tick_slice].reshape(self.periods, self.samples)

    def grid(self, reference: Real, rate_hz: float) -> LineGrid:
        """Return the excited lines of the first period of `reference` (ticks,), and the silent lines.

        The silent lines are all others from one below the lowest excited line to one above the highest. Raises
        ValueError for fewer than LEAST_LINES excited lines, and where no line is silent.
        """
        sizes = np.abs(np.fft.rfft(reference[self.start : self.start + self.samples]))
        sizes[0] = 0.0
        excited = np.flatnonzero(sizes > EXCITED_PART * sizes.max())
        if excited.size < LEAST_LINES:
            raise ValueError(
                f"reference: the recorded reference has {excited.size} frequencies; allowed: at least {LEAST_LINES}. "
                "Record a multisine with more frequencies"
            )
        silent = np.setdiff1d(np.arange(max(1, excited[0] - 1), excited[-1] + 2), excited)
        if not silent.size:
            raise ValueError(
                "reference: the multisine excites every frequency of the band; leave some frequencies out, because "
                "noise and nonlinearity show only at frequencies without excitation"
            )
        return LineGrid(self.samples, rate_hz, excited, silent)


def find_periodic_part(reference: Real) -> PeriodicPart | None:
    """Return the longest part of a reference (ticks,) with two or more equal periods after settling; None without one.

    The last one of equally long parts is returned.
    """
    parts = [part for start, end in _moving_ranges(reference) if (part := _repeating_part(reference, start, end))]
    return max(reversed(parts), key=lambda part: part.samples * part.periods, default=None)


def _moving_ranges(reference: Real) -> list[tuple[int, int]]:
    """Return first and last tick + 1 of each moving range of at least 3·LEAST_SAMPLES ticks; within one, the reference
    stands still for at most STILL_SAMPLES ticks.
    """
    moving = np.flatnonzero(np.diff(reference) != 0)
    if not moving.size:
        return []
    gaps = np.flatnonzero(np.diff(moving) > STILL_SAMPLES)
    starts, ends = moving[np.concatenate([[0], gaps + 1])], moving[np.concatenate([gaps, [moving.size - 1]])] + 2
    return [(int(a), int(b)) for a, b in zip(starts, ends, strict=True) if b - a >= 3 * LEAST_SAMPLES]


def _repeating_part(reference: Real, start: int, end: int) -> PeriodicPart | None:
    """Return the equal whole periods, two or more, about the middle of a range of the reference; None for fewer.

    One period is left out, to settle, if less than SETTLING_PART of a period precedes the repetition in the range.
    """
    part = reference[start:end]
    middle = part.size // 2
    candidate_periods = np.flatnonzero(part[middle + LEAST_SAMPLES :] == part[middle]) + LEAST_SAMPLES
    for samples in candidate_periods.tolist():
        if middle + samples + COMPARED_SAMPLES > part.size:
            return None
        if np.array_equal(
            part[middle : middle + COMPARED_SAMPLES], part[middle + samples : middle + samples + COMPARED_SAMPLES]
        ):
            break
    else:
        return None
    difference_ticks = np.flatnonzero(part[:-samples] != part[samples:])
    first = int(difference_ticks[difference_ticks < middle][-1]) + 1 if np.any(difference_ticks < middle) else 0
    last = (
        int(difference_ticks[difference_ticks > middle][0])
        if np.any(difference_ticks > middle)
        else part.size - samples
    ) + samples
    periods = (last - first) // samples
    if first < SETTLING_PART * samples:
        periods -= 1
    return PeriodicPart(start + last - periods * samples, samples, periods) if periods >= 2 else None

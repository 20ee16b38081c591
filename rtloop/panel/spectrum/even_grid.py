"""Samples on an even grid of time, as a spectrum needs them: short holes are bridged, long ones split the samples.

A loop that misses a period has no sample of it. A straight line in its place changes the density of white noise by the
share of bridged samples; a spectrum that started again at each hole would never reach its low frequencies.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.arrays import Real


class EvenGrid:
    """Puts samples on an even grid of time; a straight line bridges holes of up to `longest_hole` samples."""

    def __init__(self, longest_hole: int) -> None:
        """Begin without samples; `longest_hole` is the number of missing samples up to which a hole is bridged."""
        self._longest_hole = longest_hole
        self._last: tuple[float, float] | None = None
        """Grid index and value of the newest sample."""
        self.bridged_count = 0
        """Samples that a straight line replaced."""

    def add(self, values: Real, grid_indices: Real) -> list[tuple[bool, Real]]:
        """Add samples; return the new sequences of evenly spaced ones, oldest first: (is_continuation, samples (m,)).

        `values` (n,) stand at the whole numbers `grid_indices` (n,); values that are not finite are holes. A long hole,
        or an index that does not rise, begins a new sequence. Samples on a line over a short hole are part of their
        sequence, and counted in `bridged_count`. `is_continuation` is True for a sequence that follows the last sample
        of the call before; it may be empty. Returns [] without a finite value.
        """
        finite = np.isfinite(values)
        values, grid_indices = values[finite], grid_indices[finite]
        if values.size == 0:
            return []
        is_continuation = self._last is not None
        if self._last is not None:
            grid_indices, values = np.append(self._last[0], grid_indices), np.append(self._last[1], values)
        self._last = float(grid_indices[-1]), float(values[-1])
        strides = np.diff(grid_indices)
        breaks = 1 + np.flatnonzero((strides < 1) | (strides > self._longest_hole + 1))
        records = []
        for indices, samples in zip(np.split(grid_indices, breaks), np.split(values, breaks), strict=True):
            grid = np.arange(indices[0], indices[-1] + 1)
            self.bridged_count += grid.size - indices.size
            if grid.size > indices.size:
                samples = np.interp(grid, indices, samples)
            # The first sample of a continued record was returned by the call before.
            records.append((is_continuation, samples[1:] if is_continuation else samples))
            is_continuation = False
        return records

"""Samples on an even grid of time, as a spectrum needs them: short holes are bridged, long ones break the record.

A loop that misses a period has no sample of it. A straight line in its place changes the density of white noise by the
part of the samples that were bridged; a spectrum that began anew at each would never get to its low frequencies.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.arrays import Real


class EvenGrid:
    """Puts samples on their grid; holes of up to `longest` samples are bridged by a straight line."""

    def __init__(self, longest_hole: int) -> None:
        self._longest_hole = longest_hole
        self._last: tuple[float, float] | None = None
        self.bridged_count = 0
        """Samples that were put in."""

    def add(self, values: Real, grid_indices: Real) -> list[tuple[bool, Real]]:
        """Runs without a hole, each with whether it goes on where the one before it ended.

        `values` (n,), where what is not finite is a hole, stand at the whole numbers `places` (n,).
        """
        finite = np.isfinite(values)
        values, grid_indices = values[finite], grid_indices[finite]
        if values.size == 0:
            return []
        has_previous = self._last is not None
        if self._last is not None:
            values, grid_indices = (
                np.concatenate([[self._last[1]], values]),
                np.concatenate([[self._last[0]], grid_indices]),
            )
        self._last = float(grid_indices[-1]), float(values[-1])
        strides = np.diff(grid_indices)
        breaks = 1 + np.flatnonzero((strides < 1) | (strides > self._longest_hole + 1))
        runs = []
        for run_number, (run_indices, run_values) in enumerate(
            zip(np.split(grid_indices, breaks), np.split(values, breaks), strict=True)
        ):
            grid = np.arange(run_indices[0], run_indices[-1] + 1)
            self.bridged_count += grid.size - run_indices.size
            interpolated = np.interp(grid, run_indices, run_values) if grid.size > run_indices.size else run_values
            is_continuation = has_previous and run_number == 0
            runs.append(
                (is_continuation, interpolated[1:] if is_continuation else interpolated)
            )  # the last one before was handed out before
        return runs

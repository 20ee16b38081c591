"""Smallest and largest sample of each pixel of a screen, so that a long signal shows every peak."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real


class Envelope(NamedTuple):
    """Points of a curve: one for each sample, or one for each pixel."""

    sample: npt.NDArray[np.intp]
    """(points,): first sample of each point."""
    low: Real
    """(…, points): smallest sample of each point; NaN if it has none."""
    high: Real
    """(…, points): largest sample of each point; NaN if it has none."""
    gap: npt.NDArray[np.bool_]
    """(…, points): whether a sample of the point is NaN, so that gaps shorter than a pixel show."""


def envelope(values: Real, pixels: int) -> Envelope:
    """Return the envelope of evenly spaced samples (…, n), NaN for missing ones, on a screen of `pixels` pixels.

    Sample i lies on pixel ⌊i·pixels/n⌋; a pixel whose samples are all missing has NaN. Up to `pixels` samples are a
    point each; `low` and `high` are then `values` itself, not a copy. Raises ValueError for pixels < 1.
    """
    if pixels < 1:
        raise ValueError(f"screen: {pixels} pixels; allowed: at least 1")
    count = values.shape[-1]
    if count <= pixels:
        return Envelope(np.arange(count), values, values, np.isnan(values))
    first_samples = bin_starts(count, pixels)
    low, high = np.fmin.reduceat(values, first_samples, axis=-1), np.fmax.reduceat(values, first_samples, axis=-1)
    return Envelope(first_samples, low, high, np.isnan(np.minimum.reduceat(values, first_samples, axis=-1)))


def bin_starts(count: int, bins: int) -> npt.NDArray[np.intp]:
    """Return the index of the first sample in each of `bins` equal bins of `count` ≥ `bins` samples, (bins,)."""
    return -(-np.arange(bins) * count // bins)

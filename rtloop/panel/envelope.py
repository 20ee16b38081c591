"""What a screen shows of many samples: the smallest and the largest of each pixel, so that no peak is ever left out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real


class Envelope(NamedTuple):
    """A point a sample, or a point a pixel. `low` and `high` are NaN where a point holds no number."""

    sample: npt.NDArray[np.intp]
    """(points,): the first sample of each."""
    low: Real
    """(…, points)"""
    high: Real
    gap: npt.NDArray[np.bool_]
    """(…, points): whether a sample of the point is NaN: a gap shorter than a pixel shows as well."""


def envelope(values: Real, pixels: int) -> Envelope:
    """Of samples (…, n), evenly spaced and NaN where there is none, on `pixels` pixels: sample i is on pixel
    ⌊i·pixels/n⌋, and where there are no more samples than pixels each is a point of its own.

    Raises ValueError.
    """
    if pixels < 1:
        raise ValueError(f"screen: {pixels} pixels; at least 1 is needed")
    count = values.shape[-1]
    if count <= pixels:
        return Envelope(np.arange(count), values, values, np.isnan(values))
    first_samples = -(-np.arange(pixels) * count // pixels)  # rounded up
    low, high = np.fmin.reduceat(values, first_samples, axis=-1), np.fmax.reduceat(values, first_samples, axis=-1)
    return Envelope(first_samples, low, high, np.isnan(np.minimum.reduceat(values, first_samples, axis=-1)))

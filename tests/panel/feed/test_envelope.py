"""The envelope has the extremes that a loop over pixels and samples finds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtloop.panel.feed.envelope import envelope

SAMPLES = st.lists(st.floats(-1e6, 1e6) | st.just(math.nan), min_size=1, max_size=200)


@given(SAMPLES, st.integers(1, 60))
def test_every_pixel_holds_its_samples_extremes(samples: list[float], pixels: int):
    count = len(samples)
    points: dict[int, list[float]] = {}
    for i, sample in enumerate(samples):
        points.setdefault(i if count <= pixels else i * pixels // count, []).append(sample)
    result = envelope(np.array([samples, samples[::-1]]), pixels)
    assert len(result.sample) == len(points)
    begin = 0
    for number, (_, point_samples) in enumerate(sorted(points.items())):
        numbers = [value for value in point_samples if not math.isnan(value)]
        assert result.sample[number] == begin
        begin += len(point_samples)
        np.testing.assert_equal(result.low[0, number], min(numbers, default=math.nan))
        np.testing.assert_equal(result.high[0, number], max(numbers, default=math.nan))
        assert result.gap[0, number] == (len(numbers) < len(point_samples))
    assert result.low.shape == (2, len(points))


def test_a_peak_of_one_sample_is_never_left_out():
    samples = np.zeros(600_000)
    samples[123_457] = 1.0
    assert envelope(samples, 400).high.max() == 1.0


def test_an_envelope_of_no_samples_is_empty_and_no_pixels_are_refused():
    assert envelope(np.zeros((3, 0)), 10).low.shape == (3, 0)
    with pytest.raises(ValueError, match="screen: 0 pixels"):
        envelope(np.zeros(3), 0)

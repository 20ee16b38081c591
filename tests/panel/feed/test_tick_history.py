"""Each point of a long screen has the minimum and the maximum of exactly its ticks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.panel.feed.tick_history import BLOCK, TickHistory, history_ticks, longest_view_s

COLUMNS = ("tick", "a", "b")


def make_history(random: np.random.Generator, ticks: int, capacity: int, gaps: bool) -> tuple[TickHistory, np.ndarray]:
    """Return a history after `ticks` random ticks in random stretches, and their values (ticks, 2); NaN if lost."""
    values = random.normal(size=(ticks, 2))
    history, tick = TickHistory(COLUMNS, capacity), 0
    while tick < ticks:
        lost = int(random.integers(0, 70)) if gaps and random.random() < 0.2 else 0
        values[tick : tick + lost] = np.nan
        first = min(tick + lost, ticks)
        end = min(first + int(random.integers(1, 200)), ticks)
        if end > first:
            rows = np.column_stack([np.arange(first, end, dtype=float), values[first:end]])
            history.append(Stretch(COLUMNS, first, rows, lost, 0))
        tick = end
    return history, values


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_points_are_the_extremes_of_their_ticks(seed: int, gaps: bool):
    random = np.random.default_rng(seed)
    capacity = 40 * BLOCK
    history, values = make_history(random, 5000, capacity, gaps)
    assert history.end == 5000
    for _ in range(60):
        first = int(random.integers(5000 - 2 * capacity, 5100))
        end = first + int(random.integers(1, 2500))
        points = history.points(["b", "a"], first, end, int(random.integers(1, 60)))
        bounds = [*points.tick.tolist(), max(end, int(points.tick[-1]) + 1)]
        assert points.tick[0] <= first < points.tick[0] + BLOCK
        for column, row in enumerate((1, 0)):
            for i, (begin, beyond) in enumerate(pairwise(bounds)):
                if i == points.tick.size - 1:
                    continue  # the last block may reach beyond the screen
                expected = values[max(begin, history.begin, 0) : max(min(beyond, 5000), 0), row]
                expected = expected[np.isfinite(expected)]
                low, high = points.low[column, i], points.high[column, i]
                if begin < history.begin + BLOCK:
                    continue  # the oldest block may be overwritten in part
                assert (low, high) == (expected.min(), expected.max()) if expected.size else np.isnan(low)


def test_another_run_replaces_all():
    history = TickHistory(COLUMNS, 4 * BLOCK)
    history.append(Stretch(COLUMNS, 0, np.ones((100, 3)), 0, 0))
    history.append(Stretch(COLUMNS, 0, np.full((10, 3), 2.0), 0, 1))
    points = history.points(["a"], 0, 4 * BLOCK, 1)
    assert (history.run, history.end) == (1, 10)
    assert points.low.tolist() == points.high.tolist() == [[2.0]]


def test_a_minute_at_ten_kilohertz_fits():
    assert longest_view_s(30, 10_000) == 60.0
    assert history_ticks(30, 10_000) * 30 * 8 < 256 << 20
    assert longest_view_s(200, 50_000) < 4.0
    assert history_ticks(200, 50_000) * 200 * 8 < 256 << 20

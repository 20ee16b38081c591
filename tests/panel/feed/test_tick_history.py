"""Points of long screens hold the extremes of exactly their ticks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.panel.feed.tick_history import BLOCK, TickHistory, history_ticks, longest_view_s

COLUMNS = ("tick", "a", "b")


def fed(random: np.random.Generator, ticks: int, kept: int, gaps: bool) -> tuple[TickHistory, np.ndarray]:
    """A past that was fed random values in random lengths, and all of them; NaN where they were lost."""
    values = random.normal(size=(ticks, 2))
    past, tick = TickHistory(COLUMNS, kept), 0
    while tick < ticks:
        lost = int(random.integers(0, 70)) if gaps and random.random() < 0.2 else 0
        values[tick : tick + lost] = np.nan
        first = min(tick + lost, ticks)
        end = min(first + int(random.integers(1, 200)), ticks)
        if end > first:
            rows = np.column_stack([np.arange(first, end, dtype=float), values[first:end]])
            past.append(Stretch(COLUMNS, first, rows, lost, 0))
        tick = end
    return past, values


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_points_are_the_extremes_of_their_ticks(seed: int, gaps: bool):
    random = np.random.default_rng(seed)
    kept = 40 * BLOCK
    past, values = fed(random, 5000, kept, gaps)
    assert past.end == 5000
    for _ in range(60):
        first = int(random.integers(5000 - 2 * kept, 5100))
        end = first + int(random.integers(1, 2500))
        points = past.points(["b", "a"], first, end, int(random.integers(1, 60)))
        bounds = [*points.tick.tolist(), max(end, int(points.tick[-1]) + 1)]
        assert points.tick[0] <= first < points.tick[0] + BLOCK
        for column, row in enumerate((1, 0)):
            for i, (begin, beyond) in enumerate(pairwise(bounds)):
                if i == points.tick.size - 1:
                    continue  # of blocks, the last one may reach beyond
                wanted = values[max(begin, past.begin, 0) : max(min(beyond, 5000), 0), row]
                wanted = wanted[np.isfinite(wanted)]
                low, high = points.low[column, i], points.high[column, i]
                if begin < past.begin + BLOCK:
                    continue  # at the end of what is kept, a block may be there or not
                assert (low, high) == (wanted.min(), wanted.max()) if wanted.size else np.isnan(low)


def test_another_run_replaces_all():
    past = TickHistory(COLUMNS, 4 * BLOCK)
    past.append(Stretch(COLUMNS, 0, np.ones((100, 3)), 0, 0))
    past.append(Stretch(COLUMNS, 0, np.full((10, 3), 2.0), 0, 1))
    points = past.points(["a"], 0, 4 * BLOCK, 1)
    assert (past.run, past.end) == (1, 10)
    assert points.low.tolist() == points.high.tolist() == [[2.0]]


def test_a_minute_at_ten_kilohertz_fits():
    assert longest_view_s(30, 10_000) == 60.0
    assert history_ticks(30, 10_000) * 30 * 8 < 256 << 20
    assert longest_view_s(200, 50_000) < 4.0
    assert history_ticks(200, 50_000) * 200 * 8 < 256 << 20

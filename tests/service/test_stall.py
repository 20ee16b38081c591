"""When ticks stand still: judged in periods of the loop, and in time that the watcher was awake itself."""

from __future__ import annotations

import pytest

from rtloop.service.stall import stall_limit_s


@pytest.mark.parametrize(
    ("rate_hz", "limit_s"), [(10_000.0, 0.05), (100.0, 0.05), (15.0, 0.2), (10.0, 0.3), (1.0, 3.0), (0.1, 30.0)]
)
def test_a_slow_loop_is_not_taken_for_one_that_stands_still(rate_hz, limit_s):
    """50 ms are shorter than a period below 20 Hz."""
    assert stall_limit_s(0.05, rate_hz) == pytest.approx(limit_s)

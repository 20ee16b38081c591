"""Detection of ticks that stand still, in periods of the loop, and in time during which the watcher itself ran."""

from __future__ import annotations

import pytest

from rtloop.service.notify import Notifier
from rtloop.supervision.stall import StallWatch, stall_limit_s


@pytest.mark.parametrize(
    ("rate_hz", "limit_s"), [(10_000.0, 0.05), (100.0, 0.05), (15.0, 0.2), (10.0, 0.3), (1.0, 3.0), (0.1, 30.0)]
)
def test_a_slow_loop_is_not_taken_for_one_that_stands_still(rate_hz, limit_s):
    """Below 20 Hz, a period is longer than the limit of 50 ms."""
    assert stall_limit_s(0.05, rate_hz) == pytest.approx(limit_s)


def test_a_counter_that_stands_still_is_seen() -> None:
    watch = StallWatch(limit_s=5 / 64, longest_step_s=2 / 64)
    assert watch.stalled_s == 0.0
    assert not watch.has_stalled(7, 100.0)  # seen for the first time
    assert [watch.has_stalled(7, 100.0 + k / 64) for k in range(1, 7)] == [False] * 4 + [True] * 2


def test_time_counts_from_the_last_advance() -> None:
    watch = StallWatch(limit_s=0.05, longest_step_s=0.02)
    for k in range(100):
        assert not watch.has_stalled(k // 4, 0.01 * k)  # an advance every 40 ms


def test_a_stall_of_the_host_is_not_the_loops() -> None:
    """All processes stood still for a second, of which the watcher counts its longest step only."""
    watch = StallWatch(limit_s=0.05, longest_step_s=0.02)
    watch.has_stalled(7, 0.0)
    assert not watch.has_stalled(7, 1.0)
    assert watch.stalled_s == 0.02
    assert not watch.has_stalled(7, 2.0)
    assert watch.has_stalled(7, 3.0)  # it does not advance between the host's stalls either


def test_what_is_told_again_and_again_is_told_once_a_period() -> None:
    notifier = Notifier()
    assert [notifier.is_due(0.5, now_s) for now_s in (10.0, 10.2, 10.49, 10.5, 10.9, 11.2)] == [
        True, False, False, True, False, True,
    ]  # fmt: skip

"""Has something stopped, or did the whole machine? A counter watched with the time that the watcher was awake."""

from __future__ import annotations

import math

STALL_PERIODS = 3.0


def stall_limit_s(limit_s: float, rate_hz: float) -> float:
    """How long ticks may stand still: `limit_s`, but some periods of a loop that is slower than that."""
    return max(limit_s, STALL_PERIODS / rate_hz)


class StallWatch:
    """Watches a counter that ought to advance.

    Time counts only as far as the watcher was awake itself: a stall of the host, which stops everybody, passes in one
    long interval that counts as `longest_step_s`.
    """

    def __init__(self, limit_s: float, longest_step_s: float) -> None:
        self._limit_s, self._longest_step_s = limit_s, longest_step_s
        self._counter: int | None = None
        self._last_s = math.inf
        self.stalled_s = 0.0

    def has_stalled(self, counter: int, now_s: float) -> bool:
        """Call often, with a monotonic time; True once the counter stood still for the limit."""
        step_s, self._last_s = max(now_s - self._last_s, 0.0), now_s
        if counter != self._counter:
            self._counter, self.stalled_s = counter, 0.0
        else:
            self.stalled_s += min(step_s, self._longest_step_s)
        return self.stalled_s >= self._limit_s

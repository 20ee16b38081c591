"""Detection of a stopped counter, which tells a stopped process from a stall of the whole machine."""

from __future__ import annotations

import math

STALL_PERIODS = 3.0


def stall_limit_s(limit_s: float, rate_hz: float) -> float:
    """Return the allowed time without a tick: `limit_s`, but at least STALL_PERIODS periods."""
    return max(limit_s, STALL_PERIODS / rate_hz)


class StallWatch:
    """Watcher of a counter that should advance.

    Only time in which the watcher ran counts: a stall of the host stops the watcher, too, and shows as one long
    interval, which counts as `longest_step_s`. `stalled_s` is the counted time without a change.
    """

    def __init__(self, limit_s: float, longest_step_s: float) -> None:
        """Set the time without a change that is a stall, and the most that one pause between calls counts, in s."""
        self._limit_s, self._longest_step_s = limit_s, longest_step_s
        self._counter: int | None = None
        self._last_s = math.inf
        self.stalled_s = 0.0

    def has_stalled(self, counter: int, now_s: float) -> bool:
        """Store the counter. Returns True once it has not changed for the limit; False at the first call.

        Call it often, with a monotonic time: longer pauses between calls count as `longest_step_s`.
        """
        step_s, self._last_s = max(now_s - self._last_s, 0.0), now_s
        if counter != self._counter:
            self._counter, self.stalled_s = counter, 0.0
        else:
            self.stalled_s += min(step_s, self._longest_step_s)
        return self.stalled_s >= self._limit_s

"""Account of the ticks that are copied from one recording into another, for the event that ends the copy."""

from __future__ import annotations

from collections.abc import Mapping

from rtloop.foundation.arrays import Real
from rtloop.recording.file.topics.contents import Message, event_message
from rtloop.recording.file.topics.events import recorder_event
from rtloop.recording.file.topics.overview import MAXIMUM, Intervals, tick_ranges
from rtloop.recording.file.topics.ticks import missing_ranges
from rtloop.signals import DEADLINE, TICK


class CopyAccount:
    """Account of copied ticks from `next_tick` on: the next expected tick and the gaps (first tick, count)."""

    def __init__(self, next_tick: int, rate_hz: float) -> None:
        """Expect `next_tick` as the first tick; a tick lasts 1/`rate_hz` s."""
        self.next_tick, self._period_ns, self._end_ns = next_tick, 1e9 / rate_hz, 0.0
        self.gaps: list[tuple[int, int]] = []

    def add_rows(self, rows: Real) -> None:
        """Add copied rows (n, columns) of ticks, n > 0; missing ticks before and between them are added to `gaps`."""
        self.gaps += missing_ranges(rows[:, TICK], self.next_tick)
        self.next_tick = int(rows[-1, TICK]) + 1
        self._end_ns = float(rows[-1, DEADLINE]) + self._period_ns

    def add_intervals(self, intervals: Intervals) -> None:
        """Add intervals (n, columns, 3: minimum, maximum, mean) of ticks that the original omits by intention.

        These ticks are no gap; missing ticks before and between the intervals are added to `gaps`.
        """
        for first, count in tick_ranges(intervals):
            if first > self.next_tick:
                self.gaps.append((self.next_tick, first - self.next_tick))
            self.next_tick = first + count
        if len(intervals):
            self._end_ns = float(intervals[-1, DEADLINE, MAXIMUM]) + self._period_ns

    def end_message(self, kind: str, tick: int, details: Mapping[str, object], start_unix_ns: int) -> Message:
        """Return the event `kind` that ends the copy, at `tick`, as a message; `details` becomes its `what`.

        The time of the event is one period after the last tick in copied rows or intervals, 0 without any; log time =
        `start_unix_ns` + this time, in ns.
        """
        return event_message(recorder_event(kind, tick, round(self._end_ns), details), start_unix_ns)

"""Late ticks as one row of what happened: episodes of them, each as the loop says it, together."""

from __future__ import annotations

from typing import NamedTuple

from rtloop.recording.file.topics.events import Event

BEGINS, OVER = "periods_missed", "lateness_over"


class Episode(NamedTuple):
    """Of late ticks."""

    periods: int = 0
    """That were missed."""
    late_ticks: int = 0
    """That missed them."""
    largest: int = 0
    """Periods missed by one of them."""


class Lateness:
    """Episodes with nothing else between them. The loop says of one its first tick, and then, unless that was all, the
    whole of it.
    """

    def __init__(self, first: Event, rate_hz: float) -> None:
        self._first, self._rate_hz = first, rate_hz
        self._over: list[Episode] = []
        self._last = Episode()
        """It may go on."""
        self.add(first)

    def add(self, event: Event) -> None:
        """The beginning of an episode, or the whole of the last one."""
        details = event["what"]
        if event["kind"] == OVER:
            self._last = Episode(*(int(details[name] or 0) for name in Episode._fields))
            return
        periods = int(details["periods"] or 0)
        self._over = [self.whole]
        self._last = Episode(periods, 1, periods)

    @property
    def whole(self) -> Episode:
        """All of them as one."""
        periods, late_ticks, largest = zip(*self._over, self._last, strict=True)
        return Episode(sum(periods), sum(late_ticks), max(largest))

    def row(self) -> Event:
        """As an event of its first tick."""
        details = {**self.whole._asdict(), "worst_ms": 1e3 * self.whole.largest / self._rate_hz}
        return {**self._first, "kind": BEGINS, "what": details}

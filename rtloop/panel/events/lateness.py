"""Late ticks as one row of events: consecutive episodes, as the loop reports each, in one summary."""

from __future__ import annotations

from typing import NamedTuple

from rtloop.recording.file.topics.events import Event

LATE_KIND, LATE_END_KIND = "periods_missed", "lateness_over"


class Episode(NamedTuple):
    """Counts of an episode of late ticks."""

    periods: int = 0
    """Number of missed periods."""
    late_ticks: int = 0
    """Ticks that missed periods."""
    largest: int = 0
    """Most periods missed by one tick."""


class LateEpisodes:
    """Episodes without another event between them. The loop reports the first tick of an episode, and at the end the
    whole episode, unless that tick was all.

    `first` is the event of the first episode's first tick, `rate_hz` the loop's rate.
    """

    def __init__(self, first: Event, rate_hz: float) -> None:
        """Begin with the first episode, of which `first` reports the first tick; `rate_hz` is the loop's rate."""
        self._first_event, self._rate_hz = first, rate_hz
        self._ended = Episode()
        """Sum of all episodes before the last."""
        self._last = Episode()
        """The last episode, which may continue."""
        self.add(first)

    def add(self, event: Event) -> None:
        """Add an event: the first tick of a new episode, or the final counts of the last episode, which replace its
        earlier counts.
        """
        details = event["what"]
        if event["kind"] == LATE_END_KIND:
            self._last = Episode(*(int(details[name] or 0) for name in Episode._fields))
            return
        periods = int(details["periods"] or 0)
        self._ended, self._last = self.total, Episode(periods, 1, periods)

    @property
    def total(self) -> Episode:
        """Counts of all episodes together: sums of `periods` and `late_ticks`, and the largest `largest`."""
        a, b = self._ended, self._last
        return Episode(a.periods + b.periods, a.late_ticks + b.late_ticks, max(a.largest, b.largest))

    def summary_event(self) -> Event:
        """Return all episodes as one event at their first tick.

        Its details are `periods`, `late_ticks`, `largest` as in `Episode`, and `worst_ms`, the time of `largest`
        periods.
        """
        details = {**self.total._asdict(), "worst_ms": 1e3 * self.total.largest / self._rate_hz}
        return {**self._first_event, "kind": LATE_KIND, "what": details}

"""Late ticks as one row of what happened: episodes of them, each as the loop says it, together."""

from __future__ import annotations

from typing import NamedTuple

from rtloop.recording.file.topics.events import Event

LATE_KIND, LATE_END_KIND = "periods_missed", "lateness_over"


class Episode(NamedTuple):
    """Of late ticks."""

    periods: int = 0
    """That were missed."""
    late_ticks: int = 0
    """That missed them."""
    largest: int = 0
    """Periods missed by one of them."""


class LateEpisodes:
    """Episodes with nothing else between them. The loop says of one its first tick, and then, unless that was all, the
    whole of it.
    """

    def __init__(self, first: Event, rate_hz: float) -> None:
        self._first_event, self._rate_hz = first, rate_hz
        self._ended_episodes: list[Episode] = []
        self._last_episode = Episode()
        """It may go on."""
        self.add(first)

    def add(self, event: Event) -> None:
        """The beginning of an episode, or the whole of the last one."""
        details = event["what"]
        if event["kind"] == LATE_END_KIND:
            self._last_episode = Episode(*(int(details[name] or 0) for name in Episode._fields))
            return
        periods = int(details["periods"] or 0)
        self._ended_episodes = [self.total]
        self._last_episode = Episode(periods, 1, periods)

    @property
    def total(self) -> Episode:
        """All of them as one."""
        periods, late_ticks, largest = zip(*self._ended_episodes, self._last_episode, strict=True)
        return Episode(sum(periods), sum(late_ticks), max(largest))

    def summary_event(self) -> Event:
        """As an event of its first tick."""
        details = {**self.total._asdict(), "worst_ms": 1e3 * self.total.largest / self._rate_hz}
        return {**self._first_event, "kind": LATE_KIND, "what": details}

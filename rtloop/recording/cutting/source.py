"""What a stretch of a recording is taken from: the open files of a run, of which only what is needed is read."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.engine.memory import ring_ticks
from rtloop.recording.cutting.seek import ChunkSeeker
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Rows, snapshot_tick
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message, may_hold
from rtloop.recording.file.topics.events import FINAL, RECORDER
from rtloop.recording.file.topics.overview import MAXIMUM, MEAN, MINIMUM, OverviewLayout, Range, tick_ranges
from rtloop.signals import DEADLINE, TICK

FILE_KEYS = ("configuration_sha256", "sequence", "first_tick", "repeats_before", "cut")
"""What a header says of the one file that it stands in."""


class TickRange(NamedTuple):
    """Ticks from `first` to before `end`."""

    first: int
    end: int


class RunSource:
    """The files of one run, in its order."""

    def __init__(self, seekers: Sequence[ChunkSeeker]) -> None:
        self._seekers = seekers
        header = seekers[0].reader.header
        self.header: dict[str, Any] = {key: value for key, value in header.items() if key not in FILE_KEYS}
        self._ring_ticks = ring_ticks(header["rate_hz"])
        self._layout = OverviewLayout(header["columns"])
        self.problems: list[str] = []
        """What turned out to be damaged in `contents`."""

    @property
    def path(self) -> Path:
        """Of the first file."""
        return self._seekers[0].reader.path

    @property
    def start_unix_ns(self) -> int:
        """When the run started, by the first file that has a tick."""
        return next((seeker for seeker in self._seekers if seeker.first_span()), self._seekers[0]).reader.start_unix_ns

    @property
    def full_range(self) -> TickRange:
        """From the first tick to the last one. Raises RecordingError where there is none."""
        first = next(filter(None, (seeker.first_span() for seeker in self._seekers)), None)
        last = next(filter(None, (seeker.last_span() for seeker in reversed(self._seekers))), None)
        if first is None or last is None:
            raise RecordingError(f"{self.path}: holds no ticks")
        skipped = [first + count for seeker in self._seekers for first, count in seeker.reader.skipped_ranges]
        return TickRange(first.first, max(last.last + 1, *skipped, 0))

    def first_tick_due(self, time_s: float) -> int:
        """The first tick that was due `time_s` after the start or later. Raises RecordingError where there is none."""
        tick = self._find_tick_due(time_s)
        if tick is None:
            last = next(filter(None, (seeker.last_span() for seeker in reversed(self._seekers))), None)
            end = "it holds no ticks" if last is None else f"its last tick was due at {last.last_ns / 1e9:g} s"
            raise RecordingError(f"{self.path}: {time_s:g} s: not in the recording; {end}")
        return tick

    def first_tick_due_or_skipped(self, time_s: float) -> int:
        """As `due`; where that tick was left out by intention, the first one of the interval that it was in."""
        for overview in (seeker.reader.overview for seeker in self._seekers):
            includes_time = (overview[:, DEADLINE, MINIMUM] <= time_s * 1e9) & (
                time_s * 1e9 <= overview[:, DEADLINE, MAXIMUM]
            )
            if includes_time.any():
                return int(overview[includes_time][0, TICK, MINIMUM])
        return self.first_tick_due(time_s)

    def _find_tick_due(self, time_s: float) -> int | None:
        return next(
            (tick for seeker in self._seekers if (tick := seeker.first_tick_due(time_s * 1e9)) is not None), None
        )

    def snapshot_tick_before(self, tick: int) -> int:
        """The newest snapshot at or before `tick` whose own tick is there; `tick` of what was imported, which has none.

        Raises RecordingError.
        """
        if "imported" in self.header:
            return tick
        for seeker in reversed(self._seekers):
            for place in reversed(range(min(seeker.find_place(tick) + 1, seeker.end))):
                snapshot_ticks = [
                    snapshot_tick(message)
                    for message in self._slow_messages(seeker, place)
                    if message.channel == format.LAW
                ]
                for start_tick in sorted((message for message in snapshot_ticks if message <= tick), reverse=True):
                    if any(message.has_tick(start_tick) for message in self._seekers):
                        return start_tick
        raise RecordingError(f"{self.path}: tick {tick}: no state of the law to begin from stands at it or before it")

    def replayable_range(self, requested: TickRange) -> TickRange:
        """A stretch as it can be cut: from the newest snapshot at or before it, without what was left out at its ends.

        Raises RecordingError where nothing of it was kept.
        """
        end = requested.end
        for reader in (seeker.reader for seeker in self._seekers if seeker.reader.header.get("around")):
            for first, count in reader.skipped_ranges:
                if first <= requested.first < first + count:
                    requested = TickRange(first + count, end)
            for first, last in reader.overview[:, TICK, :MEAN]:
                if first < end <= last:
                    end = int(first)
        if not requested.first < end:
            raise RecordingError(f"{self.path}: these ticks were left out by intention: it is recorded around events")
        return TickRange(self.snapshot_tick_before(requested.first), end)

    def skipped_ranges(self, messages: Sequence[Message]) -> list[Range]:
        """What messages of a stretch say that was left out."""
        return tick_ranges(
            self._layout.parse_intervals(
                [message.payload for message in messages if message.channel == format.OVERVIEW]
            )
        )

    def file_names(self, tick_range: TickRange) -> list[str]:
        """The names of the files that hold ticks of it."""
        return [
            seeker.reader.path.name
            for seeker in self._seekers
            if (first := seeker.first_span())
            and first.first < tick_range.end
            and seeker.find_place(tick_range.first) < seeker.end
        ]

    def contents(self, tick_range: TickRange) -> Iterator[tuple[list[Message], Rows]]:
        """Messages of the slow topics and ticks of a stretch: chunk by chunk, in the order of the files."""
        next_tick = tick_range.first
        for seeker in self._seekers:
            # a message stands before the tick that it precedes, by no more ticks than the ring holds
            first, ticks = (
                seeker.find_place(tick_range.first - self._ring_ticks) - 1,
                seeker.find_place(tick_range.first),
            )
            for place in range(max(first, 0), min(seeker.find_place(tick_range.end - 1) + 1, seeker.end)):
                if place < ticks and not _may_hold_slow(seeker, place):
                    continue
                rows = seeker.rows(place, next_tick, tick_range.end)
                messages = [
                    message
                    for message in self._slow_messages(seeker, place)
                    if self._is_within(message, tick_range) and _is_owned(message, seeker)
                ]
                self.problems += seeker.damage.get(place, [])
                if len(rows):
                    next_tick = int(rows[-1, TICK]) + 1
                if len(rows) or messages:
                    yield messages, rows

    def _slow_messages(self, seeker: ChunkSeeker, place: int) -> list[Message]:
        """The messages of the slow topics in a chunk."""
        content = seeker.chunk(place) if _may_hold_slow(seeker, place) else None
        return content if isinstance(content, list) else []

    def _is_within(self, message: Message, tick_range: TickRange) -> bool:
        """Whether an event, a snapshot or an overview is of a stretch; the end of the file is not."""
        if message.channel == format.LAW:
            return tick_range.first <= snapshot_tick(message) < tick_range.end
        if message.channel == format.OVERVIEW:
            return all(
                tick_range.first <= first and first + n <= tick_range.end for first, n in self.skipped_ranges([message])
            )
        if message.channel != format.EVENTS:
            return False
        event = json.loads(message.payload)
        return tick_range.first <= event["tick"] < tick_range.end and event["kind"] not in FINAL


def _is_owned(message: Message, seeker: ChunkSeeker) -> bool:
    """Whether a message is to be taken from this file, where another one of the run holds it as well."""
    if message.channel == format.LAW:
        return seeker.reader.owns(snapshot_tick(message))
    if message.channel != format.EVENTS:
        return True
    event = json.loads(message.payload)
    return event["who"] == RECORDER or seeker.reader.owns(event["tick"])


def _may_hold_slow(seeker: ChunkSeeker, place: int) -> bool:
    entry = seeker.reader.entries[place]
    return any(may_hold(entry, channel) for channel in (format.EVENTS, format.LAW, format.OVERVIEW))

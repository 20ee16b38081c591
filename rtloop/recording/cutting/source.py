"""Open files of a run as the source of a cut; only the necessary chunks are read."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.engine.memory import ring_ticks
from rtloop.recording.cutting.seek import ChunkSeeker, ChunkSpan
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Rows, snapshot_tick
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message, may_hold
from rtloop.recording.file.topics.events import FINAL, RECORDER
from rtloop.recording.file.topics.overview import MAXIMUM, MEAN, MINIMUM, OverviewLayout, Range, tick_ranges
from rtloop.signals import DEADLINE, TICK

FILE_KEYS = ("configuration_sha256", "sequence", "first_tick", "repeats_before", "cut")
"""Header keys that belong to one file of a run, not to the run."""


class TickRange(NamedTuple):
    """Range of ticks from `first` to before `end`."""

    first: int
    end: int


class RunSource:
    """Files of one run, in its order."""

    def __init__(self, seekers: Sequence[ChunkSeeker]) -> None:
        """Take the files of one run, at least one, in its order; `header` is the first file's, without FILE_KEYS."""
        self._seekers = seekers
        header = seekers[0].reader.header
        self.header: dict[str, Any] = {key: value for key, value in header.items() if key not in FILE_KEYS}
        self._ring_ticks = ring_ticks(header["rate_hz"])
        self._layout = OverviewLayout(header["columns"])
        self.problems: list[str] = []
        """Faults of the chunks that `contents` read."""

    @property
    def path(self) -> Path:
        """Path of the first file of the run."""
        return self._seekers[0].reader.path

    @property
    def start_unix_ns(self) -> int:
        """Start of the run in UNIX ns, by the first file with a tick."""
        return next((seeker for seeker in self._seekers if seeker.first_span()), self._seekers[0]).reader.start_unix_ns

    @property
    def full_range(self) -> TickRange:
        """Range from the first recorded tick to after the last one that is recorded or was omitted by intention.

        Raises RecordingError if no file holds a tick.
        """
        first, last = next(filter(None, (seeker.first_span() for seeker in self._seekers)), None), self._last_span
        if first is None or last is None:
            raise RecordingError(f"{self.path}: holds no ticks")
        skipped = [first + count for seeker in self._seekers for first, count in seeker.reader.skipped_ranges]
        return TickRange(first.first, max(last.last + 1, *skipped, 0))

    @property
    def _last_span(self) -> ChunkSpan | None:
        """Span of the last chunk with ticks; None without ticks."""
        return next(filter(None, (seeker.last_span() for seeker in reversed(self._seekers))), None)

    def first_tick_due(self, time_s: float) -> int:
        """First tick due `time_s` (s) after the start of the run or later. Raises RecordingError if there is none."""
        for seeker in self._seekers:
            if (tick := seeker.first_tick_due(time_s * 1e9)) is not None:
                return tick
        last = self._last_span
        end = "the recording holds no ticks" if last is None else f"the last tick was due at {last.last_ns / 1e9:g} s"
        raise RecordingError(f"{self.path}: {time_s:g} s is not in the recording; {end}")

    def first_tick_due_or_skipped(self, time_s: float) -> int:
        """First tick due `time_s` (s) after the start of the run or later. Raises RecordingError if there is none.

        If that time lies in an overview interval of omitted ticks, return the first tick of the interval.
        """
        for overview in (seeker.reader.overview for seeker in self._seekers):
            includes_time = (overview[:, DEADLINE, MINIMUM] <= time_s * 1e9) & (
                time_s * 1e9 <= overview[:, DEADLINE, MAXIMUM]
            )
            if includes_time.any():
                return int(overview[includes_time][0, TICK, MINIMUM])
        return self.first_tick_due(time_s)

    def snapshot_tick_before(self, tick: int) -> int:
        """Tick of the newest snapshot at or before `tick` whose own tick is recorded. Raises RecordingError if none is.

        Returns `tick` for imported signals, which have no snapshots.
        """
        if "imported" in self.header:
            return tick
        for seeker in reversed(self._seekers):
            for place in reversed(range(min(seeker.find_place(tick) + 1, seeker.end))):
                messages = self._slow_messages(seeker, place)
                ticks = [snapshot_tick(message) for message in messages if message.channel == format.LAW]
                for start_tick in sorted((snapshot for snapshot in ticks if snapshot <= tick), reverse=True):
                    if any(candidate.has_tick(start_tick) for candidate in self._seekers):
                        return start_tick
        raise RecordingError(
            f"{self.path}: a cut begins at a snapshot of the law, and the recording has none at or before tick {tick}; "
            "cut a later range"
        )

    def replayable_range(self, requested: TickRange) -> TickRange:
        """Range that can be cut: from the newest snapshot at or before the first of `requested` that was not omitted.

        The range ends as `requested` does or, if that end is within an overview interval, before this interval.
        Raises RecordingError if all requested ticks were omitted by intention, or there is no such snapshot.
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
            raise RecordingError(
                f"{self.path}: the requested ticks were omitted; this recording has only ticks around events. Request "
                "ticks around an event"
            )
        return TickRange(self.snapshot_tick_before(requested.first), end)

    def skipped_ranges(self, messages: Sequence[Message]) -> list[Range]:
        """Ranges (first tick, count) of omitted ticks that the overviews among `messages` cover."""
        return tick_ranges(
            self._layout.parse_intervals(
                [message.payload for message in messages if message.channel == format.OVERVIEW]
            )
        )

    def file_names(self, tick_range: TickRange) -> list[str]:
        """Names of the files, without their folder, that hold ticks of a range."""
        return [
            seeker.reader.path.name
            for seeker in self._seekers
            if (first := seeker.first_span())
            and first.first < tick_range.end
            and seeker.find_place(tick_range.first) < seeker.end
        ]

    def contents(self, tick_range: TickRange) -> Iterator[tuple[list[Message], Rows]]:
        """Yield (messages, rows) of each chunk with data of a range; one of the two is empty.

        The chunks come in the order of the files. Messages are of topics other than /ticks, rows (n, columns) are
        ticks. Data in two files of the run comes once. Damaged chunks are left out; their faults are appended to
        `problems`.
        """
        next_tick = tick_range.first
        for seeker in self._seekers:
            # A message precedes its tick by no more ticks than the ring holds.
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
        """Messages in chunk number `place` of a file; [] if it holds ticks or is damaged."""
        content = seeker.chunk(place) if _may_hold_slow(seeker, place) else None
        return content if isinstance(content, list) else []

    def _is_within(self, message: Message, tick_range: TickRange) -> bool:
        """Whether an event, a snapshot or a whole overview lies in a range.

        False for every other message, and for the event that ends a file.
        """
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
    """Whether a message is to be read from the file of `seeker`; False if another file of the run gives it."""
    if message.channel == format.LAW:
        return seeker.reader.owns(snapshot_tick(message))
    if message.channel != format.EVENTS:
        return True
    event = json.loads(message.payload)
    return event["who"] == RECORDER or seeker.reader.owns(event["tick"])


def _may_hold_slow(seeker: ChunkSeeker, place: int) -> bool:
    """Whether chunk number `place` may hold events, snapshots of the law or overviews; True without an index."""
    entry = seeker.reader.entries[place]
    return any(may_hold(entry, channel) for channel in (format.EVENTS, format.LAW, format.OVERVIEW))

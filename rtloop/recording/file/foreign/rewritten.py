"""A recording that another tool wrote anew: its messages are those of a run, however they lie in the file.

They are handed out as if rtloop had written them: chunks of ticks alone and of slow messages alone, in rtloop's own
bytes and in the order of the run. Whoever reads chunks cannot tell, and believes no more of them than of its own. What
another tool may have changed is where messages lie, numbers of channels and schemas, compression, and how ticks are
encoded; not what they say.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from mcap.records import ChunkIndex

from rtloop.recording.errors import RecordingError
from rtloop.recording.file.foreign.fields import Undecodable, encoding
from rtloop.recording.file.foreign.stretches import Run, Stretch, Topics, contents, halves, runs, stretches
from rtloop.recording.file.foreign.ticks import TickDecoder
from rtloop.recording.file.mcap.chunks import Entry, Source
from rtloop.recording.file.mcap.container import DamagedChunk, pack_message
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.checked import final_event
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.header import absent, merged_header

NUMBERS = {channel.topic: channel.id for channel in format.channels()} | {format.OVERVIEW_TOPIC: format.OVERVIEW}
SLOW = (format.EVENTS, format.LAW, format.OVERVIEW)
TICKS = "/ticks"
ALWAYS = (1 << 64) - 1
AHEAD, AHEAD_BYTES = 16, 64 << 20
REMEMBERED = 4
"""Stretches: where slow messages lie together, each is needed for many chunks."""
MOST_SHOWN, SHOWN = 8, 60
"""Topics in a message, and characters of a name."""


class Slow(NamedTuple):
    """Log times of the slow messages in a stretch."""

    stretch: Stretch
    log_times: np.ndarray[Any, Any]


class Filled(NamedTuple):
    """A stretch that holds ticks, with the first and the last of their log times."""

    first: int
    last: int
    stretch: Stretch


class NoRecording(RecordingError):
    """No header of a recording was found in the file; the message says what is there."""


class Rewritten:
    """The chunks of a recording, out of an MCAP file that is not laid out as rtloop does it.

    Raises NoRecording, RecordingError where it holds what cannot be read as one, MissingExtra.
    """

    def __init__(self, source: Source) -> None:
        self._source, self._topics = source, Topics()
        self._stretches, self.problems = stretches(source)
        self.left_out = [*self.problems]
        largest = max((stretch.size for stretch in self._stretches), default=1)
        self.ahead = min(max(AHEAD_BYTES // largest, 1), AHEAD)
        """Chunks that may be unpacked beyond the one that is asked for."""
        self._payloads: list[bytes] = []
        self._counts: Counter[int] = Counter()
        self._damage: dict[Stretch, str] = {}
        self._replaced: dict[bytes, bytes] = {}
        self._slow = lru_cache(REMEMBERED)(self._slow_messages)
        filled, slow = self._survey()
        if not self._payloads:
            raise NoRecording(f"{source.path}: {self._what_it_is()}")
        self.header, sequences = merged_header(source.path, self._payloads)
        self.problems += absent(sequences)
        ticks = [number for number in self._counts if self._topics.channels[number].topic == TICKS]
        try:
            self._decoder = TickDecoder(self.header["columns"], self._topics, ticks)
        except Undecodable as reason:
            raise RecordingError(f"{source.path}: {TICKS}: {reason}") from None
        self.entries = self._in_order(filled, slow)
        if len(sequences) > 1:
            self._replaced = self._one_end(len(sequences))
            self._slow.cache_clear()

    def content(self, entry: Entry) -> bytes:
        """The records of a chunk as rtloop would have written them. Raises DamagedChunk."""
        stretch = Stretch(entry.offset, entry.length, 0)
        if entry.span is None:
            if entry.index is None:
                raise DamagedChunk(next(why for one, why in self._damage.items() if one.offset == entry.offset))
            return self._decoder.records(run for number, run in self._runs(stretch) if number == format.TICKS)
        first, last = entry.span
        return b"".join(pack_message(*one) for one in self._slow(stretch) if first <= one.log_time <= last)

    def _survey(self) -> tuple[list[Filled], list[Slow]]:
        """Where ticks and slow messages lie, which has to be known before any of it is handed out."""
        filled: list[Filled] = []
        slow: list[Slow] = []
        waiting = self._stretches[::-1]
        while waiting:
            stretch = waiting.pop()
            try:
                found = list(self._runs(stretch))
            except DamagedChunk as reason:
                smaller = halves(self._source, stretch)  # what is damaged is to be as little as can be
                waiting += smaller[::-1]
                if not smaller:
                    self._damage[stretch] = str(reason)
                continue
            for number, run in found:
                self._counts[run.channel] += len(run.records)
                self._payloads += run.payloads if number == format.CONFIGURATION else []
            ticks = [run.log_times for number, run in found if number == format.TICKS]
            others = [run.log_times for number, run in found if number in SLOW]
            if ticks:
                filled.append(Filled(min(int(t.min()) for t in ticks), max(int(t.max()) for t in ticks), stretch))
            if others:
                slow.append(Slow(stretch, np.concatenate(others)))
        return filled, slow

    def _runs(self, stretch: Stretch) -> Iterator[tuple[int | None, Run]]:
        """All messages of a stretch, with the number that rtloop gives their topic. Raises DamagedChunk."""
        for records in contents(self._source, stretch):
            for run in runs(records, self._topics):
                yield NUMBERS.get(self._topics.channels[run.channel].topic), run

    def _slow_messages(self, stretch: Stretch) -> list[Message]:
        """The events and snapshots of a stretch, by their log times."""
        return sorted(
            (
                Message(number, log_time, self._replaced.get(payload, payload))
                for number, run in self._runs(stretch)
                if number in SLOW
                for log_time, payload in zip(run.log_times.tolist(), run.payloads, strict=True)
                if self._replaced.get(payload) != b""
            ),
            key=lambda message: message.log_time,
        )

    def _in_order(self, filled: list[Filled], slow: list[Slow]) -> list[Entry]:
        """Chunks of ticks by their log times, and in front of each the slow messages that belong there."""
        filled.sort()
        for before, one in pairwise(filled):
            if one.first < before.last:
                raise RecordingError(
                    f"{self._source.path}: its ticks are in no order: those at byte {one.stretch.offset} begin before "
                    f"those at byte {before.stretch.offset} end; `mcap sort` puts a file in order"
                )
        ends = np.array([one.last for one in filled], np.uint64)
        found = [((place, 1, 0), _entry(one.stretch, {})) for place, one in enumerate(filled)]
        for stretch, log_times in slow:
            places = np.searchsorted(ends, log_times)
            for place in np.unique(places).tolist():
                span = int(ends[place - 1]) + 1 if place else 0, int(ends[place]) if place < len(ends) else ALWAYS
                first = int(log_times[places == place].min())
                found.append(((place, 0, first), _entry(stretch, dict.fromkeys(SLOW, 0), span)))
        offsets = sorted(one.stretch.offset for one in filled)
        for stretch in self._damage:
            place = int(np.searchsorted(offsets, stretch.offset))
            found.append(((place, -1, stretch.offset), Entry(stretch.offset, stretch.length, None)))
        return [entry for _, entry in sorted(found, key=lambda one: one[0])]

    def _one_end(self, parts: int) -> dict[bytes, bytes]:
        """For the event that ends each part: none, but for the last of all, whose totals become those of the file."""
        found = [
            (event, payload)
            for entry in self.entries
            if entry.span is not None
            for number, _, payload in self._slow(Stretch(entry.offset, entry.length, 0))
            if number == format.EVENTS and (event := final_event(payload, self.header["axes"]))
        ]
        replaced = {payload: b"" for _, payload in found}
        ends = {payload: event for event, payload in found}
        if len(ends) == parts:
            last = max(ends, key=lambda payload: ends[payload]["what"]["ticks_executed"])
            totals = [event["what"] for event in ends.values()]
            what = {key: sum(one[key] for one in totals) for key in ("ticks_logged", "ticks_lost")}
            what["complete"] = all(one["complete"] for one in totals)
            event = ends[last]
            replaced[last] = json.dumps(event | {"what": event["what"] | what}).encode()
        return replaced

    def _what_it_is(self) -> str:
        """Of a file without a header of a recording."""
        channels = self._topics.channels
        found = [
            f"{channels[number].topic[:SHOWN]!r} ({encoding(channels[number], self._topics.schema_of(number))}, "
            f"{count} messages)"
            for number, count in self._counts.most_common(MOST_SHOWN)
        ]
        holds = ", ".join(found) + (", …" if len(self._counts) > MOST_SHOWN else "") or "no message"
        damage = next((f"; at byte {stretch.offset} it is damaged: {why}" for stretch, why in self._damage.items()), "")
        if {NUMBERS.get(channels[number].topic) for number in self._counts} & {format.TICKS, format.LAW}:
            lacks = "a recording of rtloop without its topic /configuration, which says what the others hold"
            return f"{lacks}: there are {holds}{damage}; `rtloop import` reads its numbers"
        return f"an MCAP file, but not a recording of rtloop: it holds {holds}{damage}; `rtloop import` reads numbers"


def _entry(stretch: Stretch, offsets: dict[int, int], span: tuple[int, int] | None = None) -> Entry:
    """A chunk as an index would tell of it; its log times are told by nobody, so that it is never passed over."""
    index = ChunkIndex(stretch.length, stretch.offset, "", 0, ALWAYS, 0, offsets, 0, 0)
    return Entry(stretch.offset, stretch.length, index, span)

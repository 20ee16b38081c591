"""Numeric topics of any MCAP file: JSON, protobuf, ROS 2's CDR; nested fields by their path, with dots.

    log_time_s      when a message was logged, in s since the first one of the topic
    FIELD.INNER.0   its numbers; NaN where a message lacks one

A file that was cut off or is damaged gives what is whole of it, and `about["problems"]` says the rest.
"""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtloop.hil.modal import Real
from rtloop.interchange.formats.table import ROWS_AT_MOST, Table, UnreadableData
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.foreign.fields import Undecodable, decoder, encoding
from rtloop.recording.file.foreign.stretches import Run, Topics, contents, runs, stretches
from rtloop.recording.file.mcap.chunks import Source
from rtloop.recording.file.mcap.container import DamagedChunk

LOG_TIME = "log_time_s"
MOST_TIMES, SPARE_BYTES = 64, 64 << 20
"""What a table may take of memory: so many times what its messages take in the file, and a little more."""
MOST_SHOWN, SHOWN = 12, 60
"""Topics in a message, and characters of a name."""


class Contents(NamedTuple):
    """What is in a file: its topics, how many messages of each channel, what they take, and what is wrong with it."""

    topics: Topics
    counts: Counter[int]
    bytes: int
    problems: list[str]

    def channels(self, topic: str) -> list[int]:
        """The channels of a topic."""
        return [number for number in self.counts if self.topics.channels[number].topic == topic]

    def described(self) -> str:
        """The topics in words."""
        return ", ".join(
            f"{self.topics.channels[number].topic[:SHOWN]!r} "
            f"({encoding(self.topics.channels[number], self.topics.schema_of(number))}, {count} messages)"
            for number, count in self.counts.most_common(MOST_SHOWN)
        )


def read_mcap(path: Path | str, topic: str | None = None) -> Table:
    """The messages of a topic as a table, in the order of their log times; the file's only topic by default.

    Raises UnreadableData, MissingExtra.
    """
    path = Path(path)
    try:
        source = Source(path)
    except RecordingError as error:
        raise UnreadableData(str(error)) from None
    with closing(source):
        found = _contents(source)
        name = _chosen(path, found, topic)
        return _Reading(source, found, name).table()


def _contents(source: Source) -> Contents:
    """Every message counted."""
    topics, size = Topics(), 0
    counts: Counter[int] = Counter()
    places, problems = stretches(source)
    for stretch in places:
        try:
            found = [run for records in contents(source, stretch) for run in runs(records, topics)]
        except DamagedChunk as reason:
            problems.append(f"bytes {stretch.offset} to {stretch.offset + stretch.length} are damaged ({reason})")
            continue
        for run in found:
            counts[run.channel] += len(run.records)
            size += run.records.size
    return Contents(topics, counts, size, problems)


def _chosen(path: Path, found: Contents, topic: str | None) -> str:
    """The topic that is meant. Raises UnreadableData where nobody knows which."""
    there = {found.topics.channels[number].topic for number in found.counts}
    if topic is not None and topic in there:
        return topic
    if not there:
        raise UnreadableData(
            f"{path}: an MCAP file without messages" + "".join(f"; {one}" for one in found.problems[:1])
        )
    if topic is not None:
        raise UnreadableData(f"{path}: no topic {topic[:SHOWN]!r}; there are {found.described()}")
    if len(there) > 1:
        raise UnreadableData(f"{path}: holds several topics, of which one is to be named: {found.described()}")
    return there.pop()


class _Reading:
    """Of one topic. The columns are those that any of its messages has; memory grows with what is there alone."""

    def __init__(self, source: Source, found: Contents, topic: str) -> None:
        self._source, self._found, self._topic = source, found, topic
        self._where = f"{source.path}: {topic[:SHOWN]!r}"
        channels = found.channels(topic)
        self._rows = sum(found.counts[number] for number in channels)
        if self._rows > ROWS_AT_MOST:
            raise UnreadableData(
                f"{self._where}: {self._rows} messages; at most {ROWS_AT_MOST} are read, by `mcap filter`"
            )
        try:
            topics = found.topics
            self._decoders = {one: decoder(topics.channels[one], topics.schema_of(one)) for one in channels}
        except Undecodable as reason:
            raise UnreadableData(f"{self._where}: {reason}") from None
        self._columns: dict[str, Real] = {}
        self._log_times = np.zeros(self._rows, np.uint64)

    def table(self) -> Table:
        """All of it."""
        fill, problems = 0, self._found.problems
        for stretch in stretches(self._source)[0]:
            try:
                found = [
                    run for records in contents(self._source, stretch) for run in runs(records, self._found.topics)
                ]
            except DamagedChunk:
                continue  # it was counted as such
            for run in found:
                if run.channel in self._decoders:
                    self._take(run, fill)
                    fill += len(run.records)
        if not self._columns:
            raise UnreadableData(f"{self._where}: there is no number in its messages")
        order = np.argsort(self._log_times, kind="stable")
        in_order = bool(np.all(np.diff(order) > 0))
        log_times = self._log_times if in_order else self._log_times[order]
        elapsed_ns = (log_times - log_times[0]).astype(np.float64)
        columns = {name: one if in_order else one[order] for name, one in self._columns.items()}
        about = {
            "topic": self._topic,
            "first_log_time_ns": str(int(log_times[0])),
            **({"problems": "; ".join(problems)} if problems else {}),
        }
        return Table({LOG_TIME: elapsed_ns * 1e-9} | columns, {LOG_TIME: "s"}, LOG_TIME, about)

    def _take(self, run: Run, first: int) -> None:
        """The messages of a run as rows from `first` on. Raises UnreadableData."""
        self._log_times[first : first + len(run.records)] = run.log_times
        decode = self._decoders[run.channel]
        for row, payload in enumerate(run.payloads, first):
            try:
                fields = decode(payload)
            except Undecodable as reason:
                raise UnreadableData(f"{self._where}: message {row}: {reason}") from None
            for name, value in fields.items():
                column = self._columns.get(name)
                (self._new(name) if column is None else column)[row] = value

    def _new(self, name: str) -> Real:
        """A column, of NaN."""
        if (len(self._columns) + 1) * self._rows * 8 > MOST_TIMES * self._found.bytes + SPARE_BYTES:
            much = f"{len(self._columns)} fields and more in {self._rows} messages, each of which has few of them"
            raise UnreadableData(f"{self._where}: {much}: that is no table")
        self._columns[name] = np.full(self._rows, np.nan)
        return self._columns[name]

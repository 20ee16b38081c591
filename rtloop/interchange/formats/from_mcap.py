"""Numeric topics of any MCAP file: JSON, protobuf, ROS 2's CDR; nested fields by their path, with dots.

    log_time_s      time of a message's log, in s since the first message of the topic
    FIELD.INNER.0   its numbers; NaN where a message lacks one

The part of a file before a damage, such as a cut-off end, is read, and `about["problems"]` names the damage.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.interchange.formats.mcap_fields import DecodingError, Fields, decoder
from rtloop.interchange.formats.table import MAX_ROWS, Table, UnreadableData
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.chunks import McapSource
from rtloop.recording.file.mcap.container import MESSAGE_HEAD, DamagedChunk
from rtloop.recording.file.mcap.stock import Item, describe_topics, encoding, read_messages

LOG_TIME = "log_time_s"
MAX_GROWTH, SPARE_BYTES = 64, 64 << 20
"""Memory limit of a table: so many times the size of its messages in the file, and a spare part."""
MAX_SHOWN_CHARACTERS = 60
"""Length limit for a name in a message."""


class McapContents(NamedTuple):
    """The number of messages by topic and encoding, the bytes of each topic's messages, and the damage of a file."""

    counts: Counter[tuple[str, str]]
    bytes: Counter[str]
    problems: list[str]


def read_mcap(path: Path | str, topic: str | None = None) -> Table:
    """Return the messages of a topic as a table, in the order of their log times; of the file's only topic by default.

    Columns are `log_time_s`, from 0 at the first message, and each number of a message by its path, such as `pose.x.0`,
    NaN where a message lacks it. Messages after a damage are left out, which `about["problems"]` says. Raises
    UnreadableData if the file is no MCAP file or has no messages, if it has no `topic` or, for None, several topics,
    and if the topic has no number, too many messages or fields, or a message that cannot be decoded; MissingExtra if
    a decoder's package is missing.
    """
    path = Path(path)
    try:
        source = McapSource(path)
    except RecordingError as error:
        raise UnreadableData(str(error)) from None
    with closing(source):
        contents = _count_messages(source)
        return _TopicReader(source, contents, _choose_topic(path, contents, topic)).read_table()


def _count_messages(source: McapSource) -> McapContents:
    """Return the counts of messages and bytes by topic, up to the first damage, which `problems` names."""
    contents = McapContents(Counter(), Counter(), [])
    for schema, channel, message in _messages_until_damage(source, contents.problems):
        contents.counts[channel.topic, encoding(channel, schema)] += 1
        contents.bytes[channel.topic] += MESSAGE_HEAD.size + len(message.data)
    return contents


def _messages_until_damage(source: McapSource, problems: list[str]) -> Iterator[Item]:
    """Yield the messages of a file up to the first damage, which is appended to `problems`."""
    try:
        yield from read_messages(source)
    except DamagedChunk as reason:
        problems.append(f"{reason}: the messages after the damage are left out")


def _choose_topic(path: Path, contents: McapContents, topic: str | None) -> str:
    """Return `topic`; for None, the only topic.

    Raises UnreadableData for a file without messages or without `topic`, and, for None, with several topics.
    """
    topics = set(contents.bytes)
    if topic is not None and topic in topics:
        return topic
    if not topics:
        raise UnreadableData(
            f"{path}: an MCAP file without messages" + "".join(f"; {problem}" for problem in contents.problems[:1])
        )
    if topic is not None:
        raise UnreadableData(
            f"{path}: no topic {topic[:MAX_SHOWN_CHARACTERS]!r}; there are {describe_topics(contents.counts)}"
        )
    if len(topics) > 1:
        raise UnreadableData(
            f"{path}: contains several topics; select one with --group TOPIC: {describe_topics(contents.counts)}"
        )
    return topics.pop()


class _TopicReader:
    """Reader of one topic. Columns are the fields of any of its messages; memory grows with the fields present.

    Raises UnreadableData for more than MAX_ROWS messages.
    """

    def __init__(self, source: McapSource, contents: McapContents, topic: str) -> None:
        """Prepare for the messages of `topic`, without reading one. Raises UnreadableData for more than MAX_ROWS."""
        self._source, self._contents, self._topic = source, contents, topic
        self._location = f"{source.path}: {topic[:MAX_SHOWN_CHARACTERS]!r}"
        self._rows = sum(count for (name, _), count in contents.counts.items() if name == topic)
        if self._rows > MAX_ROWS:
            raise UnreadableData(
                f"{self._location}: {self._rows} messages; allowed: up to {MAX_ROWS}. Cut the file with `mcap filter`"
            )
        self._decoders: dict[int, Callable[[bytes], Fields]] = {}
        self._columns: dict[str, Real] = {}
        self._log_times = np.zeros(self._rows, np.uint64)

    def read_table(self) -> Table:
        """Read all messages into a table, in the order of their log times.

        Raises UnreadableData without numbers, for a message that cannot be decoded, or beyond the memory limit;
        MissingExtra if a decoder's package is missing.
        """
        problems = self._contents.problems
        items = (item for item in _messages_until_damage(self._source, []) if item[1].topic == self._topic)
        for row, item in enumerate(items):
            self._add_message(item, row)
        if not self._columns:
            raise UnreadableData(f"{self._location}: the messages contain no number")
        order = np.argsort(self._log_times, kind="stable")
        in_order = bool(np.all(np.diff(order) > 0))
        log_times = self._log_times if in_order else self._log_times[order]
        elapsed_ns = (log_times - log_times[0]).astype(np.float64)
        columns = {name: values if in_order else values[order] for name, values in self._columns.items()}
        about = {
            "topic": self._topic,
            "first_log_time_ns": str(int(log_times[0])),
            **({"problems": "; ".join(problems)} if problems else {}),
        }
        return Table({LOG_TIME: elapsed_ns * 1e-9} | columns, {LOG_TIME: "s"}, LOG_TIME, about)

    def _add_message(self, item: Item, row: int) -> None:
        """Store log time and numbers of a message in row `row`; a new field gets a column.

        Raises UnreadableData if the message cannot be decoded or its fields exceed the memory limit; MissingExtra if a
        decoder's package is missing.
        """
        schema, channel, message = item
        self._log_times[row] = message.log_time
        try:
            if channel.id not in self._decoders:
                self._decoders[channel.id] = decoder(channel, schema)
        except DecodingError as reason:
            raise UnreadableData(f"{self._location}: {reason}") from None
        try:
            fields = self._decoders[channel.id](message.data)
        except DecodingError as reason:
            raise UnreadableData(f"{self._location}: message {row}: {reason}") from None
        for name, value in fields.items():
            column = self._columns.get(name)
            (self._add_column(name) if column is None else column)[row] = value

    def _add_column(self, name: str) -> Real:
        """Add a column filled with NaN, and return it. Raises UnreadableData beyond the memory limit."""
        if (len(self._columns) + 1) * self._rows * 8 > MAX_GROWTH * self._contents.bytes[self._topic] + SPARE_BYTES:
            raise UnreadableData(
                f"{self._location}: not a table: {self._rows} messages have more than {len(self._columns)} different "
                "fields, and each message has few of them"
            )
        self._columns[name] = np.full(self._rows, np.nan)
        return self._columns[name]

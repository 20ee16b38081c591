"""Convert a recording that another MCAP tool rewrote into rtloop's own layout, once a process.

The copy is a temporary file without a name, which ends with the process or by `forget_copies`. Ticks stay equal in
bits, messages of the other topics in bytes. Other tools may use chunks of any size and compression, or none, renumber
channels and schemas, insert topics of other programs, and write ticks as JSON.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
import threading
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Schema
from mcap.records import Message as McapMessage

from rtloop.errors import OutputError
from rtloop.foundation.trusted import close_descriptor, open_own
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.chunks import McapSource
from rtloop.recording.file.mcap.container import MESSAGE_HEAD, DamagedChunk, pack_message
from rtloop.recording.file.mcap.stock import describe_topics, encoding, read_messages
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.header import read_header
from rtloop.recording.file.topics.ticks import TickLayout
from rtloop.recording.file.topics.validation import parse_final_event
from rtloop.recording.file.writer import Writer

CHANNEL_IDS = {channel.topic: channel.id for channel in format.channels()} | {format.OVERVIEW_TOPIC: format.OVERVIEW}
log = logging.getLogger("rtloop")
_copies: dict[tuple[int, ...], int] = {}
"""Descriptors of the copies by the identity of the converted files."""
_lock = threading.Lock()


def open_converted_copy(source: McapSource) -> McapSource:
    """Open the copy of a file in rtloop's own layout; the first call for a file makes the copy.

    The caller closes the returned source; `source` stays open, and the copy itself stays until `forget_copies`.
    Raises RecordingError if the file holds no recording or several, is damaged, or if the copy cannot be written.
    """
    with _lock:
        if source.identity not in _copies:
            _copies[source.identity] = _copy(source)
        copy = _copies[source.identity]
    return McapSource(source.path, lambda _: os.dup(copy))


def forget_copies() -> None:
    """Close the copies of this process, whose room is then free; a reader that is open keeps its own copy."""
    with _lock:
        while _copies:
            close_descriptor(_copies.popitem()[1])


def _copy(source: McapSource) -> int:
    """Convert a file into rtloop's own layout. Returns the descriptor of the copy, a file without a name.

    Raises RecordingError if the file holds no recording or several, is damaged, or if the copy cannot be written.
    """
    try:
        with (
            tempfile.TemporaryDirectory(prefix="rtloop-") as folder,
            closing(_Conversion(source.path, Path(folder) / "copy.mcap")) as conversion,
        ):
            return _convert(source, conversion)
    except (OutputError, OSError) as error:
        raise RecordingError(
            f"{source.path}: the converted, temporary copy cannot be written ({error}); set TMPDIR to another folder"
        ) from None


def _convert(source: McapSource, conversion: _Conversion) -> int:
    """Add all messages of a file that another tool wrote to its conversion. Returns the descriptor of the finished
    copy, a file in rtloop's own layout, which the caller closes.

    Raises RecordingError for a damaged file, and for one without a recording or with several; OutputError or OSError
    for a copy that cannot be written or opened.
    """
    try:
        for item in read_messages(source):
            conversion.add(*item)
        return open_own(conversion.finish())
    except DamagedChunk as reason:
        prefix = "" if conversion.has_begun else "the readable part is not a recording of rtloop: "
        raise RecordingError(
            f"{source.path}: {prefix}{reason}; `mcap recover` keeps the undamaged part of a file, `mcap sort` "
            "sorts the messages"
        ) from None


class _Conversion:
    """Conversion of the file `path` into `target`; its messages are added in the order of the file."""

    def __init__(self, path: Path, target: Path) -> None:
        """Prepare the conversion of `path`; the file `target` is created once the header of the recording is added."""
        self._path, self._target = path, target
        self._writer: Writer | None = None
        self._slow_messages: list[Message] = []
        """Messages of the slow topics that precede `_ticks`."""
        self._ticks: list[McapMessage] = []
        self._final: Message | None = None
        self._last_tick = -1
        self._counts: Counter[tuple[str, str]] = Counter()

    @property
    def has_begun(self) -> bool:
        """Whether the header of a recording was among the added messages."""
        return self._writer is not None

    def add(self, schema: Schema | None, channel: Channel, message: McapMessage) -> None:
        """Add a message; messages of topics that rtloop does not write are ignored.

        Raises RecordingError for a malformed or a second header, and for ticks before the header or of another schema;
        DamagedChunk for a malformed tick, ticks out of order or log times that contradict the deadlines, some of them
        only at a later message; OutputError if the copy cannot be written.
        """
        number = CHANNEL_IDS.get(channel.topic)
        if self._writer is None:
            self._counts[channel.topic, encoding(channel, schema)] += 1
        if number == format.CONFIGURATION:
            self._begin(message)
        elif number == format.TICKS:
            self._add_tick(schema, channel, message)
        elif number is not None:
            self._add_slow_message(Message(number, message.log_time, message.data))

    def finish(self) -> Path:
        """Complete the copy. Returns its path; if no event ends the recording, the copy stays an unfinished file.

        Raises RecordingError if no header was added; DamagedChunk for malformed ticks, ticks out of order or log times
        that contradict the deadlines; OutputError if the copy cannot be written.
        """
        if self._writer is None:
            raise RecordingError(
                f"{self._path}: an MCAP file, but not a recording of rtloop; topics: {describe_topics(self._counts)}. "
                "Use `rtloop import` to read numbers"
            )
        self._flush(self._writer)
        if self._final is None:  # The copy of an unfinished recording is unfinished too.
            return self._writer.part
        final = self._final
        self._writer.finish(lambda _: final, require_all=True)
        return self._target

    def close(self) -> None:
        """Close the copy without completing it; do nothing if it is closed or was never begun."""
        if self._writer is not None:
            self._writer.close()

    def _begin(self, message: McapMessage) -> None:
        """Begin the converted copy with the header of the recording; log the warning that another tool wrote it.

        Raises RecordingError for a second or a malformed header, OutputError if the copy cannot be created.
        """
        if self._writer is not None:
            raise RecordingError(
                f"{self._path}: holds several recordings, or several files of one run; allowed: one recording in one "
                "file. Open the files that were merged into this file"
            )
        self._header = read_header(self._path, message.data)
        log.warning(
            "%s: another tool wrote this recording; rtloop converts it into a temporary file. `rtloop recover` writes "
            "a permanent file", self._path
        )  # fmt: skip
        header: dict[str, Any] = {key: value for key, value in self._header.items() if key != "configuration_sha256"}
        self._layout = TickLayout(header["columns"])
        self._schema = format.tick_schema(header["columns"])
        self._rows = format.chunk_rows(header["columns"])
        self._writer = Writer(self._target, header, message.log_time, message_index=True)

    def _add_slow_message(self, message: Message) -> None:
        """Queue a message of a topic other than /ticks, but store the event that ends the file for `finish`.

        Queued ticks with an earlier log time are written first, and a queue of more than one chunk is written. Raises
        DamagedChunk for queued ticks that `_flush` refuses, OutputError if the copy cannot be written.
        """
        if self._writer is None:
            self._slow_messages.append(message)
            return
        if self._ticks and message.log_time > self._ticks[-1].log_time:
            self._flush(self._writer)
        if message.channel == format.EVENTS and parse_final_event(message.payload, self._header["axes"]):
            self._final = message
            return
        self._slow_messages.append(message)
        if sum(len(waiting.payload) for waiting in self._slow_messages) > format.MAX_CHUNK_BYTES:
            self._flush(self._writer)

    def _add_tick(self, schema: Schema | None, channel: Channel, message: McapMessage) -> None:
        """Queue a tick, in protobuf or JSON, and write the queue before it if that fills a chunk.

        Raises RecordingError before the header or for another schema; DamagedChunk for malformed JSON and for queued
        ticks that `_flush` refuses; OutputError if the copy cannot be written.
        """
        if self._writer is None:
            raise RecordingError(
                f"{self._path}: the topic /configuration, which names the signals, has no message before /ticks. Use "
                "`rtloop import` to read numbers"
            )
        if channel.message_encoding == "json":
            message.data = self._tick_from_json(message.data)
        elif schema is None or schema.data != self._schema:
            raise RecordingError(
                f"{self._path}: the messages of /ticks are encoded as {encoding(channel, schema)}, and their schema "
                "is not rtloop's; allowed: json, or protobuf with rtloop's schema. Use `rtloop import` to read numbers"
            )
        if len(self._ticks) >= self._rows and message.log_time > self._ticks[-1].log_time:
            self._flush(self._writer)
        self._ticks.append(message)

    def _tick_from_json(self, data: bytes) -> bytes:
        """Return a tick in JSON as the protobuf message that rtloop writes.

        Raises DamagedChunk for a tick that is no JSON, lacks a signal, or has a signal that is no number.
        """
        columns = self._layout.columns
        record = format.blank_ticks(columns, 1)
        try:
            fields = json.loads(data)
            values = [fields[name] for name in columns]
            if not {*map(type, values)} <= {int, float}:
                raise TypeError("a signal is not a number")
            with np.errstate(invalid="ignore"):  # A deadline may be NaN here; `_flush` refuses it.
                format.fill_ticks(record, columns, np.array([values], float), 0)
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise DamagedChunk(f"a tick in JSON cannot be read ({type(error).__name__}: {error})") from None
        return record.tobytes()[MESSAGE_HEAD.size :]

    def _flush(self, writer: Writer) -> None:
        """Write the waiting messages of topics other than /ticks, then the waiting ticks, and empty both queues.

        Raises DamagedChunk for malformed ticks, ticks out of order or log times that contradict the deadlines;
        OutputError if the copy cannot be written.
        """
        writer.write_messages(self._slow_messages)
        self._slow_messages = []
        if not self._ticks:
            return
        content = b"".join(pack_message(format.TICKS, tick.log_time, tick.data) for tick in self._ticks)
        self._ticks = []
        ticks, start_ns = self._layout.parse_ticks(content, self._layout.columns), self._layout.start_ns(content)
        if self._last_tick < 0:
            writer.start_unix_ns = start_ns
        if ticks.first <= self._last_tick:
            raise DamagedChunk(f"ticks out of order: tick {ticks.first} after tick {self._last_tick}")
        if start_ns != writer.start_unix_ns:
            raise DamagedChunk("the log times of the ticks do not match their deadlines")
        self._last_tick = ticks.last
        writer.write_ticks(ticks.rows)

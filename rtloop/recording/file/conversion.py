"""A recording that another MCAP tool wrote anew, converted once into rtloop's own layout.

The copy is a temporary file without a name, which goes with the process. Ticks stay equal in bits, messages of the
other topics in bytes. Other tools may lay messages into chunks of any size and compression, or into none, number
channels and schemas anew, put topics of others between, and write ticks as JSON.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
import threading
from collections import Counter
from pathlib import Path

import numpy as np
from mcap.records import Channel, Schema
from mcap.records import Message as McapMessage

from rtloop.errors import OutputError
from rtloop.foundation.trusted import open_own
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.chunks import McapSource
from rtloop.recording.file.mcap.container import MESSAGE_HEAD, DamagedChunk, pack_message
from rtloop.recording.file.mcap.stock import described, encoding, read_messages
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.header import read_header
from rtloop.recording.file.topics.ticks import TickLayout
from rtloop.recording.file.topics.validation import parse_final_event
from rtloop.recording.file.writer import Writer

NUMBERS = {channel.topic: channel.id for channel in format.channels()} | {format.OVERVIEW_TOPIC: format.OVERVIEW}
log = logging.getLogger("rtloop")
_copies: dict[tuple[int, ...], int] = {}
"""Descriptors of the copies, by the identity of the files that were converted."""
_lock = threading.Lock()


def converted(source: McapSource) -> McapSource:
    """Open the copy of a file in rtloop's own layout; the first call for a file makes it.

    Raises RecordingError where the file holds no recording, or one that cannot be converted.
    """
    with _lock:
        if source.identity not in _copies:
            _copies[source.identity] = _copy(source)
        copy = _copies[source.identity]
    return McapSource(source.path, lambda _: os.dup(copy))


def _copy(source: McapSource) -> int:
    """Convert a file. Returns the descriptor of the copy. Raises RecordingError."""
    with tempfile.TemporaryDirectory(prefix="rtloop-") as folder:
        conversion = _Conversion(source.path, Path(folder) / "copy.mcap")
        try:
            for item in read_messages(source):
                conversion.add(*item)
            return open_own(conversion.finish())
        except DamagedChunk as reason:
            what = "" if conversion.has_begun else "not a recording of rtloop as far as it can be read: "
            raise RecordingError(
                f"{source.path}: {what}{reason}; `mcap recover` keeps what is whole of a file, `mcap sort` puts "
                "it in order"
            ) from None
        except (OutputError, OSError) as error:
            raise RecordingError(
                f"{source.path}: no room to convert it ({error}); TMPDIR names another folder"
            ) from None
        finally:
            conversion.close()


class _Conversion:
    """Writes `target` from the messages of the file `path`, added in its order."""

    def __init__(self, path: Path, target: Path) -> None:
        self._path, self._target = path, target
        self._writer: Writer | None = None
        self._others: list[Message] = []
        """Messages of the slow topics that stand in front of `_ticks`."""
        self._ticks: list[McapMessage] = []
        self._final: Message | None = None
        self._last_tick = -1
        self._counts: Counter[tuple[str, str]] = Counter()

    @property
    def has_begun(self) -> bool:
        """Whether the header of a recording was among the messages."""
        return self._writer is not None

    def add(self, schema: Schema | None, channel: Channel, message: McapMessage) -> None:
        """Take a message. Raises RecordingError, DamagedChunk, OutputError."""
        number = NUMBERS.get(channel.topic)
        if self._writer is None:
            self._counts[channel.topic, encoding(channel, schema)] += 1
        if number == format.CONFIGURATION:
            self._begin(message)
        elif number == format.TICKS:
            self._add_tick(schema, channel, message)
        elif number is not None:
            self._add_other(Message(number, message.log_time, message.data))

    def finish(self) -> Path:
        """Complete the copy. Returns its path. Raises RecordingError, DamagedChunk, OutputError."""
        if self._writer is None:
            holds = described(self._counts)
            raise RecordingError(
                f"{self._path}: an MCAP file, but not a recording of rtloop: it holds {holds}; `rtloop import` reads "
                "numbers"
            )
        self._flush()
        if self._final is None:  # a recording without an end stays one
            return self._writer.part
        final = self._final
        self._writer.finish(lambda _: final, require_all=True)
        return self._target

    def close(self) -> None:
        """Close the copy; idempotent."""
        if self._writer is not None:
            self._writer.close()

    def _begin(self, message: McapMessage) -> None:
        """Begin the copy with the header of the recording."""
        if self._writer is not None:
            raise RecordingError(
                f"{self._path}: holds several recordings or parts of one; allowed: one. Open the files that it was "
                "merged from"
            )
        self._header = read_header(self._path, message.data)
        log.warning(
            "%s: another tool wrote this recording; it is converted into a temporary file, `rtloop recover` makes a "
            "lasting one", self._path
        )  # fmt: skip
        header = {key: value for key, value in self._header.items() if key != "configuration_sha256"}
        self._layout = TickLayout(header["columns"])
        self._rows = format.chunk_rows(header["columns"])
        self._writer = Writer(self._target, header, message.log_time, message_index=True)

    def _add_other(self, message: Message) -> None:
        if self._ticks and message.log_time > self._ticks[-1].log_time:
            self._flush()
        if (
            self._writer
            and message.channel == format.EVENTS
            and parse_final_event(message.payload, self._header["axes"])
        ):
            self._final = message
            return
        self._others.append(message)
        if self._writer and sum(len(other.payload) for other in self._others) > format.MAX_CHUNK_BYTES:
            self._flush()

    def _add_tick(self, schema: Schema | None, channel: Channel, message: McapMessage) -> None:
        if self._writer is None:
            raise RecordingError(
                f"{self._path}: a recording without its topic /configuration in front of /ticks, which says what they "
                "hold; `rtloop import` reads numbers"
            )
        if channel.message_encoding == "json":
            message.data = self._tick_from_json(message.data)
        elif schema is None or schema.data != format.tick_schema(self._layout.columns):
            raise RecordingError(
                f"{self._path}: /ticks: its messages are {encoding(channel, schema)} of another schema; allowed: "
                "protobuf with the schema of the recording, json. `rtloop import` reads numbers"
            )
        if len(self._ticks) >= self._rows and message.log_time > self._ticks[-1].log_time:
            self._flush()
        self._ticks.append(message)

    def _tick_from_json(self, data: bytes) -> bytes:
        """Turn a tick in JSON into the protobuf that rtloop writes, without other fields. Raises DamagedChunk."""
        columns = self._layout.columns
        record = format.blank_ticks(columns, 1)
        try:
            fields = json.loads(data)
            values = [fields[name] for name in columns]
            if not {*map(type, values)} <= {int, float}:
                raise TypeError("a signal is no number")
            with np.errstate(invalid="ignore"):  # a deadline may be NaN here: `_flush` refuses it
                format.fill_ticks(record, columns, np.array([values], float), 0)
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise DamagedChunk(f"a tick in JSON cannot be read ({type(error).__name__}: {error})") from None
        return record.tobytes()[MESSAGE_HEAD.size :]

    def _flush(self) -> None:
        """Write what waits: the messages of the slow topics, then the ticks that they precede."""
        assert self._writer is not None
        self._writer.write_messages(self._others)
        self._others = []
        if not self._ticks:
            return
        content = b"".join(pack_message(format.TICKS, tick.log_time, tick.data) for tick in self._ticks)
        self._ticks = []
        ticks, start_ns = self._layout.parse_ticks(content, self._layout.columns), self._layout.start_ns(content)
        if self._last_tick < 0:
            self._writer.start_unix_ns = start_ns
        if ticks.first <= self._last_tick:
            raise DamagedChunk(f"out of order: tick {ticks.first} after {self._last_tick}")
        if start_ns != self._writer.start_unix_ns:
            raise DamagedChunk("its log times do not go with its deadlines")
        self._last_tick = ticks.last
        self._writer.write_ticks(ticks.rows)

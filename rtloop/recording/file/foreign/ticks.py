"""Ticks as another tool may have encoded them, in rtloop's own bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from rtloop.recording.file.foreign.container import LARGEST_BYTES
from rtloop.recording.file.foreign.fields import Fields, Undecodable, decoder, message_class
from rtloop.recording.file.foreign.stretches import Run, Topics
from rtloop.recording.file.mcap.container import MESSAGE_HEAD, DamagedChunk
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.ticks import LARGEST_NS
from rtloop.signals import DEADLINE, TICK

Rows = np.ndarray[Any, Any]


class TickDecoder:
    """Of a recording with `columns`, whose ticks are on `channels`. Raises Undecodable, MissingExtra."""

    def __init__(self, columns: Sequence[str], topics: Topics, channels: Iterable[int]) -> None:
        self._columns = tuple(columns)
        self._blank = format.blank_ticks(self._columns, 1)
        tags = np.ones(self._blank.itemsize, bool)
        tags[: MESSAGE_HEAD.size] = False
        for name in self._columns:
            _, start, *_ = (self._blank.dtype.fields or {})[name]
            tags[start : start + 8] = False
        self._tags = np.flatnonzero(tags)
        self._tag_bytes = self._blank.view(np.uint8)[self._tags]
        self._topics = topics
        self._numbered = {channel for channel in channels if self._is_numbered(channel)}
        self._decoders: dict[int, Callable[[bytes], Fields]] = {
            channel: decoder(topics.channels[channel], topics.schema_of(channel))
            for channel in channels
            if channel not in self._numbered
        }
        self._start_ns: int | None = None

    def records(self, runs: Iterable[Run]) -> bytes:
        """The ticks of some runs, in order, as rtloop writes them. Raises DamagedChunk.

        Their log times are the first one's start of the run plus their deadlines, as they were when they were recorded.
        """
        found = list(runs)
        if sum(len(run.records) for run in found) * self._blank.itemsize > LARGEST_BYTES:
            raise DamagedChunk(f"its ticks take more than {LARGEST_BYTES >> 20} MiB")
        rows = np.concatenate([self._rows(run) for run in found])
        if self._start_ns is None:
            self._start_ns = _start_ns(int(found[0].log_times[0]), rows[0, DEADLINE])
        if np.any(np.diff(rows[:, TICK]) <= 0):
            rows = rows[np.argsort(rows[:, TICK], kind="stable")]
        records = format.blank_ticks(self._columns, len(rows))
        with np.errstate(invalid="ignore"):  # a deadline may be anything: it is checked behind
            format.fill_ticks(records, self._columns, rows, self._start_ns)
        return records.tobytes()

    def _rows(self, run: Run) -> Rows:
        """The signals (n, columns) of a run, bit for bit."""
        if run.channel in self._numbered and run.records.shape[1] == self._blank.itemsize:
            found = run.records[:, self._tags]
            if np.array_equal(found, np.broadcast_to(self._tag_bytes, found.shape)):
                return format.tick_rows(run.records.view(self._blank.dtype)[:, 0], self._columns)
        try:
            return np.array([self._row(fields) for fields in map(self._decoder(run.channel), run.payloads)])
        except Undecodable as reason:
            raise DamagedChunk(f"a tick: {reason}") from None

    def _row(self, fields: Fields) -> list[float]:
        try:
            return [fields[name] for name in self._columns]
        except KeyError as missing:
            raise Undecodable(f"it has no {missing.args[0]}") from None

    def _decoder(self, channel: int) -> Callable[[bytes], Fields]:
        """What decodes a message field by field."""
        if channel not in self._decoders:
            self._decoders[channel] = decoder(self._topics.channels[channel], self._topics.schema_of(channel))
        return self._decoders[channel]

    def _is_numbered(self, channel: int) -> bool:
        """Whether the messages are protobuf whose fields have the names and numbers that rtloop gives them."""
        schema = self._topics.schema_of(channel)
        if self._topics.channels[channel].message_encoding != "protobuf" or schema is None:
            return False
        if schema.data == format.tick_schema(self._columns):
            return True
        fields = message_class(schema).DESCRIPTOR.fields
        doubles = [(field.name, field.number) for field in fields if field.type == field.TYPE_DOUBLE]
        return doubles == [(name, number) for number, name in enumerate(self._columns, start=1)]


def _start_ns(log_time: int, deadline_ns: float) -> int:
    """When the run started, by a tick; what is no time becomes one."""
    return min(max(log_time - int(deadline_ns), 0), LARGEST_NS) if 0 <= deadline_ns < LARGEST_NS else 0

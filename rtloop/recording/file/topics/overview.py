"""Overview of the ticks that a recording around events omits: least, largest and mean value of every signal.

One message of `/overview` covers consecutive ticks: a protobuf message (proto2) with three doubles a
column, `NAME_min`, `NAME_max`, `NAME_mean`, in the order of the columns, all present. `tick_min` and `tick_max` are the
first and the last of its ticks, `deadline_ns_min` and `deadline_ns_max` when these were due. NaN values are
ignored; the three figures are NaN if all values are. Exactly the ticks that these messages cover were omitted by
intention: a missing tick that no message covers was lost.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.records import Channel, McapRecord, Schema

from rtloop.foundation.arrays import Real
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.ticks import LARGEST
from rtloop.signals import DEADLINE, TICK

MINIMUM, MAXIMUM, MEAN = range(3)
STATISTICS = ("min", "max", "mean")
LARGEST_FIELD_BYTES = 3 + 8
"""Size of a double with a tag of three bytes."""
Intervals = Real
"""Array (n, columns, 3) of statistics: minimum, maximum, mean."""
Range = tuple[int, int]
"""Range of ticks: first tick, count."""


def most_intervals(columns: int) -> int:
    """Return how many intervals of `columns` signals fit into a chunk of MAX_CHUNK_BYTES; 1 if none does.

    The reader refuses chunks that are much larger.
    """
    return max(1, format.MAX_CHUNK_BYTES // (len(STATISTICS) * columns * LARGEST_FIELD_BYTES))


def overview_records(columns: Sequence[str]) -> list[McapRecord]:
    """Return the schema and channel records of the topic `/overview`."""
    data = format.doubles_schema("Overview", _field_names(columns))
    return [
        Schema(id=format.OVERVIEW_SCHEMA, name="rtloop.Overview", encoding="protobuf", data=data),
        Channel(
            id=format.OVERVIEW,
            topic=format.OVERVIEW_TOPIC,
            message_encoding="protobuf",
            metadata={},
            schema_id=format.OVERVIEW_SCHEMA,
        ),
    ]


class Extremes(NamedTuple):
    """Least, largest and mean values of one signal, shape (n,) each."""

    least: Real
    most: Real
    mean: Real


class Overview:
    """Statistics of the omitted ticks by interval: `overview["x_error_um"].most` is an array of shape (n,)."""

    def __init__(self, columns: Sequence[str], intervals: Intervals) -> None:
        """Take intervals (n, columns, 3: minimum, maximum, mean) of the signals `columns`."""
        self._columns, self._intervals = list(columns), intervals

    def __len__(self) -> int:
        """Number of intervals."""
        return len(self._intervals)

    def __getitem__(self, name: str) -> Extremes:
        """Return least, largest and mean values of a signal by interval. Raises KeyError for an unknown name."""
        if name not in self._columns:
            raise KeyError(f"no signal {name!r}; allowed: {', '.join(self._columns)}")
        return Extremes(*self._intervals[:, self._columns.index(name)].T)

    @property
    def tick(self) -> Real:
        """The first tick of each interval (n,)."""
        return self["tick"].least

    @property
    def ticks(self) -> Real:
        """Number of ticks in each interval (n,)."""
        return self["tick"].most - self["tick"].least + 1

    @property
    def time_s(self) -> Real:
        """Deadline of each interval's first tick (n,), in s since the start of the run; missed periods count too."""
        return self["deadline_ns"].least * 1e-9

    @property
    def end_s(self) -> Real:
        """Deadline of each interval's last tick (n,), in s since the start of the run."""
        return self["deadline_ns"].most * 1e-9


class OverviewLayout:
    """Layout of the overview messages of a recording with `columns`."""

    def __init__(self, columns: Sequence[str]) -> None:
        """Make the layout of messages with three figures for each of `columns`."""
        self._columns, names = len(columns), _field_names(columns)
        self._dtype = np.dtype(format.doubles(names))
        self._names = names
        self._template = np.zeros(1, self._dtype)
        format.fill_tags(self._template, names)
        self._fixed, self._tags = format.fixed_bytes(self._template, names)

    def make_messages(self, intervals: Intervals, start_unix_ns: int) -> list[Message]:
        """Make one message for each of the intervals (n, columns, 3: minimum, maximum, mean).

        Log time = `start_unix_ns` + deadline of the interval's first tick, in ns.
        """
        records = np.repeat(self._template, len(intervals))
        for index, name in enumerate(self._names):
            records[name] = intervals[:, index // len(STATISTICS), index % len(STATISTICS)]
        times = intervals[:, DEADLINE, MINIMUM].astype(np.int64) + start_unix_ns
        return [
            Message(format.OVERVIEW, int(time), record.tobytes()) for time, record in zip(times, records, strict=True)
        ]

    def require_overview(self, payload: bytes) -> None:
        """Raise ValueError for a payload whose length or fields do not match these columns."""
        if len(payload) != self._dtype.itemsize:
            raise ValueError("the overview of ticks that were not recorded is damaged: it has a wrong length")
        if not np.array_equal(np.frombuffer(payload, np.uint8)[self._fixed], self._tags):
            raise ValueError(
                "the overview of ticks that were not recorded is damaged: its fields are not those of the recording"
            )

    def parse_intervals(self, payloads: Sequence[bytes]) -> Intervals:
        """Return intervals (n, columns, 3: minimum, maximum, mean) of n payloads that `require_overview` accepted."""
        records = np.frombuffer(b"".join(payloads), self._dtype)
        intervals = np.empty((len(records), self._columns, len(STATISTICS)))
        for index, name in enumerate(self._names):
            intervals[:, index // len(STATISTICS), index % len(STATISTICS)] = records[name]
        return intervals


def are_plausible(intervals: Intervals) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the valid ones of intervals (n, columns, 3: minimum, maximum, mean).

    Ticks and deadlines of a valid interval are whole numbers that follow those of all earlier intervals, valid or not.
    """
    is_plausible = np.ones(len(intervals), bool)
    for column in (TICK, DEADLINE):
        minimum, maximum = intervals[:, column, MINIMUM], intervals[:, column, MAXIMUM]
        is_plausible &= (minimum >= 0) & (minimum <= maximum) & (maximum <= LARGEST) & (minimum == np.floor(minimum))
        is_plausible &= maximum == np.floor(maximum)
        previous_maximum = np.fmax.accumulate(np.concatenate([[-1.0], maximum[:-1]]))
        is_plausible &= minimum > previous_maximum
    return is_plausible


def tick_ranges(intervals: Intervals) -> list[Range]:
    """Return the ranges (first tick, count) that intervals (n, columns, 3: minimum, maximum, mean) cover.

    The intervals must ascend by tick; adjacent ones are merged.
    """
    if not len(intervals):
        return []
    first, end = intervals[:, TICK, MINIMUM].astype(np.int64), intervals[:, TICK, MAXIMUM].astype(np.int64) + 1
    breaks = np.flatnonzero(first[1:] != end[:-1]) + 1
    begins, ends = np.concatenate([[0], breaks]), np.concatenate([breaks, [len(first)]]) - 1
    return [(int(first[begin]), int(end[last] - first[begin])) for begin, last in zip(begins, ends, strict=True)]


def uncovered_ranges(first: int, end: int, covered: Iterable[Range]) -> list[Range]:
    """Return the ranges (first tick, count) of the ticks [first, end) that no range of `covered` contains.

    `covered` are ranges (first tick, count) too, sorted by tick.
    """
    gaps = []
    for begin, count in covered:
        if begin + count <= first:
            continue
        if begin >= end:
            break
        if begin > first:
            gaps.append((first, begin - first))
        first = begin + count
    return [*gaps, (first, end - first)] if first < end else gaps


def _field_names(columns: Sequence[str]) -> list[str]:
    """Return NAME_min, NAME_max, NAME_mean of each column in turn, the order of a message."""
    return [f"{column}_{part}" for column in columns for part in STATISTICS]

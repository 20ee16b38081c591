"""The ticks of a chunk: an array of records, of which each is checked to be one before a number of it is handed out.

What is used as an index, a count or a time must be one: `tick`, `deadline_ns`, `periods_missed`, `flags`, `mode`,
`driver_status`. Every other signal may be any double.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rtloop.recording.file.mcap.container import DamagedChunk
from rtloop.recording.file.topics import format
from rtloop.signals import Mode

LARGEST, LARGEST_NS = float(1 << 53), 1 << 62
INTEGER_COLUMNS = {
    "tick": (0, LARGEST),
    "deadline_ns": (0, LARGEST),
    "periods_missed": (0, LARGEST),
    "flags": (0, 2**32 - 1),
    "mode": (min(Mode), max(Mode)),
    "driver_status": (-(2**31), 2**31 - 1),
}
"""Columns of whole numbers, with the least and the largest."""


class Ticks(NamedTuple):
    """Columns of consecutive records, shape (n, columns), their ticks (n,), and the first and the last of these."""

    rows: np.ndarray[Any, Any]
    numbers: np.ndarray[Any, Any]
    first: int
    last: int

    def from_tick(self, tick: int) -> Ticks | None:
        """Ticks numbered `tick` or above; None if all are below it."""
        if self.last < tick:
            return None
        index = int(np.searchsorted(self.numbers, tick))
        return Ticks(self.rows[index:], self.numbers[index:], int(self.numbers[index]), self.last)


class TickLayout:
    """Byte layout of the ticks of a recording with `columns`."""

    def __init__(self, columns: Sequence[str]) -> None:
        self.columns = tuple(columns)
        self._template = format.blank_ticks(self.columns, 1)
        varying = ("_log_time", "_publish_time", *self.columns)
        is_fixed = np.ones(self._template.itemsize, bool)
        for name in varying:
            _, start, *_ = (self._template.dtype.fields or {})[name]
            is_fixed[start : start + 8] = False
        self._fixed = np.flatnonzero(is_fixed)
        self._fixed_bytes = self._template.view(np.uint8)[self._fixed]

    def parse_ticks(self, content: bytes, names: Sequence[str]) -> Ticks:
        """The columns `names` of a chunk of ticks. Raises DamagedChunk."""
        dtype = self._template.dtype
        if len(content) % dtype.itemsize:
            raise DamagedChunk("its length is not that of whole ticks")
        fixed = np.frombuffer(content, np.uint8).reshape(-1, dtype.itemsize)[:, self._fixed]
        if not np.array_equal(fixed, np.broadcast_to(self._fixed_bytes, fixed.shape)):
            raise DamagedChunk("it holds more than ticks")
        records: np.ndarray[Any, Any] = np.frombuffer(content, dtype)
        _require_integers(records)
        _require_times(records)
        tick = records["tick"]
        return Ticks(format.tick_rows(records, names), tick, int(tick[0]), int(tick[-1]))

    def start_ns(self, content: bytes) -> int:
        """Log time of the start of the run, in ns since the UNIX epoch, by a chunk of ticks. Raises DamagedChunk."""
        ticks = self.parse_ticks(content, ["deadline_ns"])
        records: np.ndarray[Any, Any] = np.frombuffer(content, self._template.dtype, count=1)
        return int(records["_log_time"][0]) - int(ticks.rows[0, 0])


def missing_ranges(ticks: np.ndarray[Any, Any], expected: int) -> list[tuple[int, int]]:
    """(first tick, how many) of all that is missing in `ticks` (n,), n > 0, which are to begin at `expected`."""
    if ticks[0] == expected and ticks[-1] == expected + len(ticks) - 1:  # the usual case
        return []
    ticks_with_start = np.concatenate([[expected - 1], ticks]).astype(np.int64)
    return [
        (int(ticks_with_start[i]) + 1, int(ticks_with_start[i + 1] - ticks_with_start[i]) - 1)
        for i in np.flatnonzero(np.diff(ticks_with_start) != 1)
    ]


def _require_integers(records: np.ndarray[Any, Any]) -> None:
    for name in INTEGER_COLUMNS.keys() & set(
        records.dtype.names or ()
    ):  # measured signals that were imported have few of them
        if fault := integer_problem(name, records[name]):
            raise DamagedChunk(fault)


def integer_problem(name: str, values: np.ndarray[Any, Any]) -> str | None:
    """Describe the fault in a column of whole numbers; None if there is none."""
    low, high = INTEGER_COLUMNS[name]
    is_valid = (values >= low) & (values <= high) & (values == np.floor(values))
    if is_valid.all():
        return None
    return f"{name}: {float(values[np.argmin(is_valid)]):g}; a whole number from {low:g} to {high:g} is allowed"


def _require_times(records: np.ndarray[Any, Any]) -> None:
    """Ticks and deadlines that grow, and log times that go with the deadlines."""
    for name in ("tick", "deadline_ns"):
        is_growing = np.diff(records[name]) > 0
        if not is_growing.all():
            row = int(np.argmin(is_growing)) + 1
            raise DamagedChunk(f"out of order: {name} {records[name][row]:g} after {records[name][row - 1]:g}")
    starts = records["_log_time"] - records["deadline_ns"].astype(np.uint64)
    is_consistent = np.all(starts == starts[0]) and np.array_equal(records["_publish_time"], records["_log_time"])
    if not is_consistent or records["_log_time"].max() >= LARGEST_NS:
        raise DamagedChunk("its log times do not go with its deadlines")

"""Ticks of a chunk: an array of records that are checked before any number is returned.

Indices, counts and times must be whole numbers in range: `tick`, `deadline_ns`, `periods_missed`, `flags`, `mode`,
`driver_status`. Every other signal may be any double.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real
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
"""Least and largest allowed value of the columns of whole numbers."""


class Ticks(NamedTuple):
    """Rows (n, columns) of the ticks of a chunk, their numbers (n,), and the first and last of these."""

    rows: Real
    numbers: Real
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
        self._fixed, self._fixed_bytes = format.fixed_bytes(self._template, varying)

    def parse_ticks(self, content: bytes, names: Sequence[str]) -> Ticks:
        """Parse the columns `names` of a chunk of ticks.

        Raises DamagedChunk if it holds anything but ticks of these columns, a value is out of range in INTEGER_COLUMNS,
        ticks or deadlines do not grow, or log times contradict the deadlines.
        """
        dtype = self._template.dtype
        if len(content) % dtype.itemsize:
            raise DamagedChunk("the length is not a multiple of a tick's")
        fixed = np.frombuffer(content, np.uint8).reshape(-1, dtype.itemsize)[:, self._fixed]
        if not np.array_equal(fixed, np.broadcast_to(self._fixed_bytes, fixed.shape)):
            raise DamagedChunk("contains other data than ticks")
        records: format.Records = np.frombuffer(content, dtype)
        _require_integers(records)
        _require_times(records)
        tick = records["tick"]
        return Ticks(format.tick_rows(records, names), tick, int(tick[0]), int(tick[-1]))

    def start_ns(self, content: bytes) -> int:
        """Start of the run, in ns since the UNIX epoch, computed from a chunk of ticks.

        Raises DamagedChunk as `parse_ticks` does.
        """
        ticks = self.parse_ticks(content, ["deadline_ns"])
        records: format.Records = np.frombuffer(content, self._template.dtype, count=1)
        return int(records["_log_time"][0]) - int(ticks.rows[0, 0])


def missing_ranges(first: Real, expected: int, last: Real | None = None) -> list[tuple[int, int]]:
    """Return the ranges (first tick, count) missing before and between ticks (n,), which should begin at `expected`.

    `first` and `last` (n,) are the ends of intervals of ticks; without `last`, `first` are single ticks.
    """
    ends = np.concatenate([[expected], (first if last is None else last)[:-1] + 1])[: len(first)]
    return [(int(ends[row]), int(first[row] - ends[row])) for row in np.flatnonzero(first != ends)]


def _require_integers(records: format.Records) -> None:
    """Raise DamagedChunk for a value that is not whole or out of range in INTEGER_COLUMNS.

    Columns that imported signals lack are skipped.
    """
    for name in INTEGER_COLUMNS.keys() & set(records.dtype.names or ()):
        if fault := integer_problem(name, records[name]):
            raise DamagedChunk(fault)


def integer_problem(name: str, values: Real) -> str | None:
    """Describe the first of `values` that is not whole or out of range in INTEGER_COLUMNS; None if there is none."""
    low, high = INTEGER_COLUMNS[name]
    is_valid = (values >= low) & (values <= high) & (values == np.floor(values))
    if is_valid.all():
        return None
    return f"{name}: {float(values[np.argmin(is_valid)]):g}; allowed: a whole number from {low:g} to {high:g}"


def _require_times(records: format.Records) -> None:
    """Raise DamagedChunk unless ticks and deadlines grow and the log times agree with the deadlines."""
    for name in ("tick", "deadline_ns"):
        is_growing = np.diff(records[name]) > 0
        if not is_growing.all():
            row = int(np.argmin(is_growing)) + 1
            raise DamagedChunk(f"out of order: {name} {records[name][row]:g} after {records[name][row - 1]:g}")
    starts = records["_log_time"] - records["deadline_ns"].astype(np.uint64)
    is_consistent = np.all(starts == starts[0]) and np.array_equal(records["_publish_time"], records["_log_time"])
    if not is_consistent or records["_log_time"].max() >= LARGEST_NS:
        raise DamagedChunk("log times contradict the deadlines")

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
from rtloop.recording.file.topics.tick_kernels import RecordLayout, first_fault
from rtloop.signals import Mode

TIME_FIELDS = ("_log_time", "_publish_time")
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
    """Ticks of a chunk: rows (n, columns), tick numbers (n,), and the first and the last of these numbers."""

    rows: Real
    numbers: Real
    first: int
    last: int

    def from_tick(self, tick: int) -> Ticks | None:
        """Return the ticks numbered `tick` or above, as views of these; None if all are below it."""
        if self.last < tick:
            return None
        index = int(np.searchsorted(self.numbers, tick))
        return Ticks(self.rows[index:], self.numbers[index:], int(self.numbers[index]), self.last)


class TickLayout:
    """Byte layout of the ticks of a recording with `columns`."""

    def __init__(self, columns: Sequence[str]) -> None:
        """Make the layout of tick messages with `columns`, the first two of which are tick and deadline_ns."""
        self.columns = tuple(columns)
        self._template = format.blank_ticks(self.columns, 1)
        varying = (*TIME_FIELDS, *self.columns)
        is_fixed = np.zeros(self._template.itemsize, bool)
        is_fixed[format.fixed_bytes(self._template, varying)[0]] = True
        self._records = RecordLayout(self._template.view(np.uint8), is_fixed)
        fields = self._template.dtype.fields or {}
        self._offsets = {name: int(fields[name][1]) for name in varying}
        self._integer_columns = [name for name in INTEGER_COLUMNS if name in self.columns]
        self._bounds = np.array([INTEGER_COLUMNS[name] for name in self._integer_columns], float)

    def parse_ticks(self, content: bytes, names: Sequence[str]) -> Ticks:
        """Return the ticks of an unpacked chunk, with the columns `names` in this order.

        Raises DamagedChunk if it holds anything but ticks of the recording's columns, a value of INTEGER_COLUMNS is not
        whole or out of range, ticks or deadlines do not grow, or log times contradict the deadlines. Raises ValueError
        without a tick.
        """
        if len(content) % self._template.itemsize:
            raise DamagedChunk("a block of ticks has a damaged length: no multiple of the length of a tick")
        fields = (*names, *self._integer_columns, *TIME_FIELDS)
        words = self._records.take_out(content, np.array([self._offsets[name] for name in fields]))
        if words is None:
            raise DamagedChunk("contains other data than ticks")
        integers, times_ns = words[len(names) : -2].view(np.float64), words[-2:].view(np.int64)
        if (fault := first_fault(integers, self._bounds, times_ns, LARGEST_NS)) is not None:
            raise DamagedChunk(self._describe_fault(integers.T, *fault))
        tick = integers[0]
        return Ticks(words[: len(names)].view(np.float64).T, tick, int(tick[0]), int(tick[-1]))

    def _describe_fault(self, integers: Real, check: int, row: int) -> str:
        """Return the message for a fault found by `first_fault` in the whole numbers (n, columns)."""
        columns = self._integer_columns
        if check < len(columns):
            return integer_problem(columns[check], integers[row : row + 1, check]) or ""
        if check < len(columns) + 2:
            name, values = columns[check - len(columns)], integers[:, check - len(columns)]
            return f"out of order: {name} {values[row]:.0f} after {values[row - 1]:.0f}"
        return "the log times of the ticks do not match their deadlines"

    def start_ns(self, content: bytes) -> int:
        """Start of the run, in ns since the UNIX epoch, computed from a chunk of ticks.

        Raises DamagedChunk as `parse_ticks` does.
        """
        ticks = self.parse_ticks(content, ["deadline_ns"])
        records: format.Records = np.frombuffer(content, self._template.dtype, count=1)
        return int(records["_log_time"][0]) - int(ticks.rows[0, 0])


def missing_ranges(first: Real, expected: int, last: Real | None = None) -> list[tuple[int, int]]:
    """Return the missing ranges of ticks, as (first missing tick, count), from tick `expected` on; [] if none.

    Present are the ticks `first` (n,), or, with `last` (n,), the intervals `first` … `last`, both ends included. They
    ascend, and begin at `expected` or later. Ticks after the last one are not missing.
    """
    ends = np.concatenate([[expected], (first if last is None else last)[:-1] + 1])[: len(first)]
    return [(int(ends[row]), int(first[row] - ends[row])) for row in np.flatnonzero(first != ends)]


def integer_problem(name: str, values: Real) -> str | None:
    """Describe the first of `values` (n,) that is no whole number in the range of column `name`; None if there is none.

    `name` is a key of INTEGER_COLUMNS.
    """
    low, high = INTEGER_COLUMNS[name]
    is_valid = (values >= low) & (values <= high) & (values == np.floor(values))
    if is_valid.all():
        return None
    return f"{name}: {values[np.argmin(is_valid)]:.17g}; allowed: a whole number from {low:g} to {high:g}"

"""Compiled passes over a chunk of ticks: take out its values, check the bytes around them, numbers and times."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.foundation.native.compiled import python_entry
from rtloop.foundation.native.pointers import address_pointer, carray, load_word

WORD_BYTES = 8


class RecordLayout:
    """Layout of records of equal length, some of whose bytes are the same in all records."""

    def __init__(self, template: npt.NDArray[np.uint8], is_fixed: npt.NDArray[np.bool_]) -> None:
        """Take a record `template` (size,), whose bytes are the same in all records where `is_fixed` (size,) is True.

        Raises ValueError for records of less than eight bytes, and for arrays of different lengths.
        """
        self.size = len(template)
        if self.size < WORD_BYTES or len(is_fixed) != self.size:
            raise ValueError(
                f"layout of a record: the template has {self.size} bytes and {len(is_fixed)} flags of fixed bytes; "
                f"allowed: at least {WORD_BYTES} bytes, and one flag for each byte"
            )
        starts = np.minimum(np.arange(0, self.size, WORD_BYTES), self.size - WORD_BYTES)
        self._starts = starts.astype(np.int64)
        mask = np.where(is_fixed, 0xFF, 0).astype(np.uint8)
        self._words = np.stack([
            np.array([part[start : start + WORD_BYTES].view(np.uint64)[0] for start in starts])
            for part in (np.ascontiguousarray(template), mask)
        ])  # fmt: skip

    def take_out(self, content: bytes, offsets: npt.NDArray[np.int64]) -> npt.NDArray[np.uint64] | None:
        """Return the 8-byte words (k, n) at byte `offsets` (k,) of each of the n records in `content`.

        Offsets count from the start of a record. None if a record has another value in a byte that the layout fixes.
        Raises ValueError if `content` is not whole records, or a word would reach beyond its record.
        """
        count, excess = divmod(len(content), self.size)
        if excess or not np.all((offsets >= 0) & (offsets <= self.size - WORD_BYTES)):
            raise ValueError(
                f"records: the content has {len(content)} bytes, the offsets of the values in a record are "
                f"{offsets.tolist()}; allowed: whole records of {self.size} bytes, offsets from 0 to "
                f"{self.size - WORD_BYTES}"
            )
        words = np.empty((len(offsets), count), np.uint64)
        places = np.ascontiguousarray(offsets, np.int64)
        is_equal = _take_out(
            np.frombuffer(content, np.uint8).ctypes.data, count, self.size, self._starts.ctypes.data,
            self._words.ctypes.data, len(self._starts), places.ctypes.data, len(places), words.ctypes.data,
        )  # fmt: skip
        return words if is_equal else None


def first_fault(
    numbers: Real, bounds: Real, log_times_ns: npt.NDArray[np.int64], end_ns: int
) -> tuple[int, int] | None:
    """Return (check, row) of the first fault in ticks: checks in order, and rows within each; None without a fault.

    `numbers` (columns, n) has ticks in row 0, deadlines in row 1, then other whole numbers; `bounds` (columns, 2) their
    least and largest values; `log_times_ns` (2, n) two log times of each tick. Checks 0 … columns − 1: the column is
    whole and in bounds. The next two: tick and deadline are above those of the tick before. The last one: both log
    times are equal, from 0 to before `end_ns`, and after the deadline by the same time as in the first tick.
    Raises ValueError for other shapes, and without a tick.
    """
    columns, count = numbers.shape
    if columns < 2 or bounds.shape != (columns, 2) or log_times_ns.shape != (2, count) or not count:
        raise ValueError(
            f"arrays of ticks: numbers has {columns} columns and {count} ticks, bounds has the shape "
            f"{' × '.join(map(str, bounds.shape))}, log_times_ns has the shape "
            f"{' × '.join(map(str, log_times_ns.shape))}; allowed: at least 2 columns and 1 tick, bounds of "
            f"{columns} × 2, log_times_ns of 2 × {count}"
        )
    arrays = [np.ascontiguousarray(numbers, np.float64), np.ascontiguousarray(bounds, np.float64)]
    times = np.ascontiguousarray(log_times_ns, np.int64)
    place = _first_fault(*(array.ctypes.data for array in (*arrays, times)), columns, count, end_ns)
    return None if place < 0 else divmod(place, count)


@python_entry("int64(intp, intp, intp, int64, int64, int64)")
def _first_fault(numbers_address, bounds_address, times_address, columns, count, end_ns):
    """Return check · count + row of the first fault as `first_fault` defines it; −1 if there is none."""
    numbers = carray(address_pointer(numbers_address), (columns, count), np.float64)
    bounds = carray(address_pointer(bounds_address), (columns, 2), np.float64)
    times = carray(address_pointer(times_address), (2, count), np.int64)
    for j in range(columns):
        for i in range(count):
            value = numbers[j, i]
            if not (bounds[j, 0] <= value <= bounds[j, 1]) or value != np.floor(value):
                return j * count + i
    for j in range(2):
        for i in range(1, count):
            if numbers[j, i] <= numbers[j, i - 1]:
                return (columns + j) * count + i
    start_ns = times[0, 0] - np.int64(numbers[1, 0])
    for i in range(count):
        time_ns = times[0, i]
        is_valid = 0 <= time_ns < end_ns and times[1, i] == time_ns
        if not is_valid or time_ns - np.int64(numbers[1, i]) != start_ns:
            return (columns + 2) * count + i
    return -1


@python_entry("int64(intp, int64, int64, intp, intp, int64, intp, int64, intp)")
def _take_out(
    content, count, size, starts_address, words_address, word_count, offsets_address, offset_count, out_address
):  # fmt: skip
    """Copy words of `count` records, each `size` bytes long, to `out_address` as `RecordLayout.take_out` does.

    Returns 1, or 0 at the first record whose fixed bytes differ from the template. The words at `words_address` are
    (2, word_count): template and mask; the offsets of these words in a record are at `starts_address`.
    """
    starts = carray(address_pointer(starts_address), word_count, np.int64)
    words = carray(address_pointer(words_address), (2, word_count), np.uint64)
    offsets = carray(address_pointer(offsets_address), offset_count, np.int64)
    out = carray(address_pointer(out_address), (offset_count, count), np.uint64)
    for i in range(count):
        record = content + i * size
        difference = np.uint64(0)
        for k in range(word_count):
            difference |= (load_word(record + starts[k]) ^ words[0, k]) & words[1, k]
        if difference != np.uint64(0):
            return 0
        for j in range(offset_count):
            out[j, i] = load_word(record + offsets[j])
    return 1

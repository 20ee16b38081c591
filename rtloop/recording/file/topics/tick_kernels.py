"""Compiled check of the whole numbers and times in a chunk of ticks: in range, growing, consistent."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.foundation.native.compiled import python_entry
from rtloop.foundation.native.pointers import address_pointer, carray


def first_fault(
    numbers: Real, bounds: Real, log_times_ns: npt.NDArray[np.int64], end_ns: int
) -> tuple[int, int] | None:
    """Return (check, row) of the first fault in ticks: checks in order, and rows within each; None without a fault.

    `numbers` (columns, n) has ticks in row 0, deadlines in row 1, then other whole numbers; `bounds` (columns, 2) their
    least and largest values; `log_times_ns` (2, n) two log times of each tick. Checks 0 … columns − 1: the column is
    whole and in bounds. The next two: tick and deadline are above those of the tick before. The last one: both log
    times are equal, 0 … before `end_ns`, and after the deadline by the same time as in the first tick.
    Raises ValueError for other shapes, and without a tick.
    """
    columns, count = numbers.shape
    if columns < 2 or bounds.shape != (columns, 2) or log_times_ns.shape != (2, count) or not count:
        raise ValueError(
            f"numbers: {numbers.shape}, bounds: {bounds.shape}, times: {log_times_ns.shape}; "
            "allowed: (columns, n), (columns, 2), (2, n) with 2 columns and 1 tick at least"
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

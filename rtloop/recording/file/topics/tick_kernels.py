"""Compiled checks of a chunk of ticks: bytes that never vary, whole numbers in range, times that grow."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.foundation.native.compiled import python_entry
from rtloop.foundation.native.pointers import address_pointer, carray

Bytes = npt.NDArray[np.uint8]


def has_other_bytes(content: bytes, template: Bytes, mask: Bytes) -> bool:
    """Whether a record in `content` differs from `template` in a bit of `mask`; both are (bytes of a record,).

    Raises ValueError for a content that is no whole number of records.
    """
    size = template.size
    if mask.size != size or not size or len(content) % size:
        raise ValueError(f"content: {len(content)} bytes; allowed: a multiple of {size}, the size of template and mask")
    data = np.frombuffer(content, np.uint8)
    masked, mask = np.ascontiguousarray(template & mask), np.ascontiguousarray(mask)
    addresses = data.ctypes.data, len(content) // size, size, masked.ctypes.data, mask.ctypes.data
    return bool(_has_other_bytes(*addresses))


def first_fault(
    numbers: Real, bounds: Real, log_times_ns: npt.NDArray[np.int64], end_ns: int
) -> tuple[int, int] | None:
    """Return the first fault in ticks as (check, row), None without one; the checks follow each other.

    `numbers` (columns, n) has ticks, deadlines and other whole numbers, `bounds` (columns, 2) their least and largest
    values. Check number j, for each column j: a value is not whole or out of bounds. The next two: ticks and deadlines
    do not grow. The last one: `log_times_ns` (2, n) are not two equal times, 0 … before `end_ns`, that all lie one
    constant after the deadlines.
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


@python_entry("int64(intp, int64, int64, intp, intp)")
def _has_other_bytes(content_address, count, size, template_address, mask_address):
    """Return 1 if a record differs from the template in a bit of the mask, else 0."""
    content = carray(address_pointer(content_address), count * size, np.uint8)
    template = carray(address_pointer(template_address), size, np.uint8)
    mask = carray(address_pointer(mask_address), size, np.uint8)
    for i in range(count):
        difference = np.uint8(0)  # In eight bits, so that the compiler takes 32 bytes at once.
        for j in range(size):
            difference = np.uint8(difference | np.uint8((content[i * size + j] & mask[j]) ^ template[j]))
        if difference != 0:
            return 1
    return 0


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

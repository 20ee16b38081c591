"""Compiled passes over the ticks of a replay: the comparison with the recording, and the tape of recorded inputs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop import signals
from rtloop.foundation.arrays import Real
from rtloop.foundation.native.compiled import jit, python_entry
from rtloop.foundation.native.pointers import address_pointer, carray

FIRST_MEASURED, LAST_MEASURED = min(signals.MEASURED_COLUMNS), max(signals.MEASURED_COLUMNS)
FLAGS, DEADLINE, LATENESS, PERIODS_MISSED = signals.FLAGS, signals.DEADLINE, signals.LATENESS, signals.PERIODS_MISSED
OVERRUN, HEARTBEAT_LOST = int(signals.Flag.OVERRUN), int(signals.Flag.HEARTBEAT_LOST)
WRITE_FAILED = int(signals.Flag.WRITE_FAILED)
ITEM_BYTES = 8


class Strided(NamedTuple):
    """Rows (n, columns) float64 as a kernel takes them: an address, and the steps between rows and columns in items."""

    address: int
    row_step: int
    column_step: int

    @classmethod
    def of(cls, rows: Real) -> Strided:
        """Return the address of `rows`, valid as long as `rows` exists, and the steps in items of eight bytes.

        Raises ValueError for items that are not float64, and for steps that are negative or not whole items.
        """
        if rows.dtype != np.float64 or any(step % ITEM_BYTES or step < 0 for step in rows.strides):
            raise ValueError(
                f"array of ticks: values of type {rows.dtype}, steps of {rows.strides[0]} bytes between rows and "
                f"{rows.strides[1]} bytes between columns; allowed: float64, steps of 0, 8, 16, … bytes"
            )
        row_step, column_step = (step // ITEM_BYTES for step in rows.strides)
        return cls(rows.ctypes.data, row_step, column_step)


def first_unequal(recorded: Real, replayed: Real) -> tuple[int, int] | None:
    """Return (row, column) of the first value (n, columns) that differs in bytes; None if none does.

    The first one is in the least row, and there in the least column.
    Measured columns and the flag OVERRUN count as equal; `replayed` may have more rows than `recorded`, not fewer.
    Raises ValueError for shapes that do not fit, and for values that are not float64.
    """
    count, columns = recorded.shape
    if replayed.shape[0] < count or replayed.shape[1] != columns or columns <= FLAGS:
        raise ValueError(
            f"replayed values: an array of {' × '.join(map(str, replayed.shape))}; allowed: at least {count} rows "
            f"of {columns} values"
        )
    place = _first_unequal(*Strided.of(recorded), *Strided.of(replayed), count, columns) if count else -1
    return None if place < 0 else divmod(place, columns)


def fill_tape(rows: Real, pairs: npt.NDArray[np.int64], tape: Real, refused: npt.NDArray[np.bool_]) -> None:
    """Fill the first n rows of a playback tape from recorded `rows` (n, columns).

    Also set the first n of `refused`: True in a tick whose write to the drives had failed.
    Columns 0 to 3 of the tape are: deadline and wake, in ns; missed periods; infinity in a tick with a lost heartbeat,
    else NaN. `pairs` (k, 2) are other columns of the tape and the recorded columns that they copy. Raises ValueError
    for shapes and columns that do not fit, and for values that are not float64.
    """
    count, columns = rows.shape
    is_within = np.all(pairs >= 0) and np.all(pairs[:, 0] < tape.shape[1]) and np.all(pairs[:, 1] < columns)
    if not is_within or tape.shape[0] < count or refused.size < count or tape.shape[1] < 4 or columns <= FLAGS:
        raise ValueError(
            f"tape of recorded inputs: the tape has {tape.shape[0]} rows, {tape.shape[1]} columns and {refused.size} "
            f"flags of refused writes, the recording has {count} ticks and {columns} columns; allowed: a row and a "
            "flag for each tick, at least 4 columns of the tape, pairs of existing columns (one of the tape, one of "
            "the recording)"
        )
    if count:
        _fill_tape(
            *Strided.of(rows), count, columns, pairs.ctypes.data, len(pairs), *Strided.of(tape), tape.shape[1],
            refused.ctypes.data,
        )  # fmt: skip


@jit
def _bits(address: int, row_step: int, column_step: int, count: int, columns: int) -> npt.NDArray[np.uint64]:
    """Return the values at an address as bits, 1-D: row i, column j is number i row_step + j column_step."""
    return carray(address_pointer(address), (count - 1) * row_step + (columns - 1) * column_step + 1, np.uint64)


@jit
def _values(address: int, row_step: int, column_step: int, count: int, columns: int) -> Real:
    """Return the values at an address, 1-D: row i, column j is number i row_step + j column_step."""
    return carray(address_pointer(address), (count - 1) * row_step + (columns - 1) * column_step + 1, np.float64)


@jit
def _is_flag_equal(recorded: float, replayed: float) -> bool:
    """Whether two values of `flags` are equal but for OVERRUN, and the recorded one is a whole number and not −0."""
    flags = np.int64(recorded)
    return (
        flags & ~OVERRUN == np.int64(replayed) & ~OVERRUN
        and recorded == np.float64(flags)
        and (flags != 0 or not np.signbit(recorded))
    )


@python_entry("int64(intp, int64, int64, intp, int64, int64, int64, int64)")
def _first_unequal(recorded, row_step, column_step, replayed, other_row_step, other_column_step, count, columns):
    """Return row · columns + column of the first unequal value as `first_unequal` defines it; −1 if there is none."""
    a = _bits(recorded, row_step, column_step, count, columns)
    b = _bits(replayed, other_row_step, other_column_step, count, columns)
    flags = _values(recorded, row_step, column_step, count, columns)
    other_flags = _values(replayed, other_row_step, other_column_step, count, columns)
    first = count
    for j in range(columns):
        if FIRST_MEASURED <= j <= LAST_MEASURED:
            continue
        for i in range(first):
            at, other = i * row_step + j * column_step, i * other_row_step + j * other_column_step
            if a[at] != b[other] and not (j == FLAGS and _is_flag_equal(flags[at], other_flags[other])):
                first = i
                break
    if first == count:
        return -1
    for j in range(columns):
        if FIRST_MEASURED <= j <= LAST_MEASURED:
            continue
        at, other = first * row_step + j * column_step, first * other_row_step + j * other_column_step
        if a[at] != b[other] and not (j == FLAGS and _is_flag_equal(flags[at], other_flags[other])):
            return first * columns + j
    return -1


@python_entry("int64(intp, int64, int64, int64, int64, intp, int64, intp, int64, int64, int64, intp)")
def _fill_tape(
    rows, row_step, column_step, count, columns, pairs_address, pair_count, tape_address, tape_row_step,
    tape_column_step, tape_columns, refused_address,
):  # fmt: skip
    """Fill the tape as `fill_tape` says. Returns 0."""
    recorded = _values(rows, row_step, column_step, count, columns)
    tape = _values(tape_address, tape_row_step, tape_column_step, count, tape_columns)
    pairs = carray(address_pointer(pairs_address), (pair_count, 2), np.int64)
    refused = carray(address_pointer(refused_address), count, np.bool_)
    for i in range(count):
        row, out = i * row_step, i * tape_row_step
        deadline_ns, lateness_us = recorded[row + DEADLINE * column_step], recorded[row + LATENESS * column_step]
        flags = np.int64(recorded[row + FLAGS * column_step])
        tape[out] = deadline_ns
        tape[out + tape_column_step] = deadline_ns + np.rint(lateness_us * 1e3)  # whole ns, and so the same µs
        tape[out + 2 * tape_column_step] = recorded[row + PERIODS_MISSED * column_step]
        tape[out + 3 * tape_column_step] = np.inf if flags & HEARTBEAT_LOST != 0 else np.nan
        refused[i] = flags & WRITE_FAILED != 0
    for k in range(pair_count):
        target, source = pairs[k, 0] * tape_column_step, pairs[k, 1] * column_step
        for i in range(count):
            tape[i * tape_row_step + target] = recorded[i * row_step + source]
    return 0

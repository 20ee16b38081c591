"""Kind `playback`, for replay: returns recorded inputs and times to the loop, tick by tick."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rtloop.drivers.base import Pointers
from rtloop.foundation.native.compiled import cfunc
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, carray

CONTEXT = np.dtype([(name, np.int64) for name in ("rows", "columns", "row", "address", "refusals")])
EXHAUSTED = 1
TIMING_COLUMNS = 4
"""Number of columns at the beginning of a row that `wait` returns; the read's status and its values follow."""


@cfunc(SIGNATURE)
def playback_wait(context, timing):
    """Fill `timing` with the first TIMING_COLUMNS values of the next row, as `Playback.load` lists them; return 0.

    After the last row, return EXHAUSTED, which ends the run.
    """
    tape = carray(context, 1, CONTEXT)[0]
    if tape.row >= tape.rows:
        return EXHAUSTED
    data = carray(address_pointer(tape.address), (tape.rows, tape.columns), np.float64)
    out = carray(timing, TIMING_COLUMNS)
    for i in range(TIMING_COLUMNS):
        out[i] = data[tape.row, i]
    return 0


@cfunc(SIGNATURE)
def playback_read(context, values):
    """Fill `values` with inputs (V), age (µs) and observed signals of the row whose times `playback_wait` has given.

    Moves to the next row, and returns the recorded status of the read.
    """
    tape = carray(context, 1, CONTEXT)[0]
    data = carray(address_pointer(tape.address), (tape.rows, tape.columns), np.float64)
    first = TIMING_COLUMNS + 1
    out = carray(values, tape.columns - first)
    for i in range(tape.columns - first):
        out[i] = data[tape.row, first + i]
    status = np.int32(data[tape.row, TIMING_COLUMNS])
    tape.row += 1
    return status


@cfunc(SIGNATURE)
def playback_write(context, values):
    """Return −1 if the recorded write of this tick failed, else 0. `values`, the loop's drives, are ignored."""
    tape = carray(context, 1, CONTEXT)[0]
    if tape.refusals == 0:
        return 0
    refused_writes = carray(address_pointer(tape.refusals), tape.rows, np.bool_)
    return -1 if refused_writes[tape.row - 1] else 0


class Playback:
    """Recorded rows, each with the columns that `load` describes, for the loop; one segment at a time."""

    def __init__(self) -> None:
        """Begin without rows; `load` sets them."""
        self._context = np.zeros(1, CONTEXT)
        self._rows: npt.NDArray[np.float64] = np.empty((0, TIMING_COLUMNS + 1))
        self._refused_writes: npt.NDArray[np.bool_] | None = None

    def load(self, rows: npt.NDArray[np.float64], refused_writes: npt.NDArray[np.bool_] | None = None) -> None:
        """Play `rows` (n, TIMING_COLUMNS + 1 + inputs + 1 + observed) from the first, in place of rows loaded before.

        Columns: deadline and wake in ns; number of missed periods; the time in ns that the loop compares with its
        heartbeat (infinity: heartbeat lost, NaN: not lost); status of the read; inputs in V; age in µs; observed
        signals. `refused_writes` (n,) is True where the recorded write failed; None if no write failed. Both arrays may
        be used without a copy: do not change them while they are played.
        """
        self._rows = np.ascontiguousarray(rows, dtype=np.float64)
        self._refused_writes = None if refused_writes is None else np.ascontiguousarray(refused_writes)
        self._context["refusals"] = 0 if self._refused_writes is None else self._refused_writes.ctypes.data
        self._context["rows"], self._context["columns"] = self._rows.shape
        self._context["row"], self._context["address"] = 0, self._rows.ctypes.data

    def pointers(self) -> Pointers:
        """Return pointers to the driver's functions and context, with `playback_wait` as the clock."""
        addresses = playback_read.address, playback_write.address, playback_wait.address
        return Pointers(self._context.ctypes.data, *addresses)

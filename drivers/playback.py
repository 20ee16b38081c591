"""Kind `playback`: hands recorded inputs back to the loop, tick by tick. Used by replay, not by configurations."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drivers.base import Pointers
from hil.compiled import cfunc
from hil.pointers import SIGNATURE, address_pointer, carray

CONTEXT = np.dtype([("rows", np.int64), ("columns", np.int64), ("row", np.int64), ("address", np.int64)])
EXHAUSTED = -100


@cfunc(SIGNATURE)
def playback_read(context, values):
    """The next row: status in its first column, then what the driver's read gave."""
    tape = carray(context, 1, CONTEXT)[0]
    if tape.row >= tape.rows:
        return EXHAUSTED
    data = carray(address_pointer(tape.address), (tape.rows, tape.columns), np.float64)
    out = carray(values, tape.columns - 1)
    for i in range(tape.columns - 1):
        out[i] = data[tape.row, i + 1]
    tape.row += 1
    return np.int32(data[tape.row - 1, 0])


@cfunc(SIGNATURE)
def playback_write(context, values):
    """Accept and ignore: the caller compares what the loop recorded."""
    return 0


class Playback:
    """A tape of rows (status, inputs…, age, observed…), which may be replaced by the next stretch at any tick."""

    def __init__(self) -> None:
        self._context = np.zeros(1, CONTEXT)
        self._rows: npt.NDArray[np.float64] = np.empty((0, 1))

    def load(self, rows: npt.NDArray[np.float64]) -> None:
        """Continue with `rows` (n, 1 + inputs + 1 + observed)."""
        self._rows = np.ascontiguousarray(rows, dtype=np.float64)
        self._context["rows"], self._context["columns"] = self._rows.shape
        self._context["row"], self._context["address"] = 0, self._rows.ctypes.data

    def pointers(self) -> Pointers:
        """Pointers that read from the tape."""
        return Pointers(self._context.ctypes.data, playback_read.address, playback_write.address)

"""Commands to the loop and events from it: one fixed-size record for both.

A command is put into the queue (or the schedule) with the tick from which it may take effect; the loop alone decides
at which tick it does, and says so by an event of the same kind, values and origin.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np

MESSAGE_VALUES = 12
MESSAGE = np.dtype(
    [
        ("tick", np.int64),
        ("kind", np.int64),
        ("axis", np.int64),
        ("origin", np.int64),
        ("identity", np.int64),
        ("values", np.float64, (MESSAGE_VALUES,)),
    ]
)
ALL_AXES = -1


class Kind(IntEnum):
    """Kinds below 100 are commands, and events once they took effect; the rest are events only."""

    SET_MODE = 1
    """values[0]: Mode; values[2]: 1 to hold what is in force where a reference in volts would be taken for micrometres,
    or the other way round."""
    SET_REFERENCE = 2
    """values: Generator kind, then its parameters."""
    RESET_TRIP = 3
    STOP = 4
    """Ramp down, then end."""
    LOAD_LAW = 5
    """Take the staged coefficients of the axis; values[0]: 1 where the controller is another one."""
    REFUSED = 100
    """values[0]: kind of the command; values[1]: its first value."""
    TRIPPED = 101
    """values[0]: the new causes as Flag bits. Of the axis named, 0 where none is to blame: values[3] the cause found
    first, values[1] what was beyond its limit, values[2] (µm, V or µs; a count of ticks or swings). A law that failed:
    values[1] what it returned, values[2] its `Failure`, values[4] its number."""
    PARKED = 102
    """All outputs are at their safe values."""
    DRIVER_FAILED = 103
    """values[0]: status returned; values[1]: 0 read, 1 write."""
    PERIODS_MISSED = 104
    """values[0]: periods missed by the tick that begins an episode of late ticks."""
    LATENESS_OVER = 105
    """One to two seconds without a missed period, or the end of the run, after more than one tick that missed some.
    values: the periods missed in the whole episode, by how many ticks, and by one at most."""


class Origin(IntEnum):
    """Who asked."""

    LOOP = 0
    SCHEDULE = 1
    OPERATOR = 2
    SUPERVISOR = 3
    CAN = 4


def message(
    kind: Kind, *, tick: int = 0, axis: int = ALL_AXES, origin: Origin = Origin.OPERATOR, values: Any = ()
) -> np.ndarray[Any, Any]:
    """One record of MESSAGE, shape (1,)."""
    record = np.zeros(1, MESSAGE)
    record["tick"], record["kind"], record["axis"], record["origin"] = tick, kind, axis, origin
    record["values"][0, : len(values)] = values
    return record

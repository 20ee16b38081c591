"""Commands to the loop and events from it: one fixed-size record for both.

A command enters the schedule with the tick from which it takes effect, or the queue, where its tick does not count. The
loop alone decides at which tick it takes effect, and acknowledges it by an event of the same kind, values and origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
import numpy.typing as npt

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
    """values[0]: Mode; values[2]: 1 to hold the present reference if its unit (V or µm) would change with the mode."""
    SET_REFERENCE = 2
    """values: Generator kind, then its parameters."""
    RESET_TRIP = 3
    STOP = 4
    """Ramp the outputs down, then end the loop."""
    LOAD_LAW = 5
    """Activate the staged coefficients of the axis; values[0]: 1 for a different controller."""
    REFUSED = 100
    """values[0]: kind of the command; values[1]: its first value."""
    TRIPPED = 101
    """values[0]: the new causes as Flag bits. values[3]: first cause of the axis, 0 without axis; values[1]: its value
    and values[2]: its limit, in the unit of the Flag member. Failure of a law: values[1] is the returned value,
    values[2] the `Failure`, values[4] the law's number. A lost heartbeat alone: values[1] is the length of the silence
    and values[2] the heartbeat's timeout, in s, values[4] the `Silence`."""
    PARKED = 102
    """All outputs are at their safe values."""
    DRIVER_FAILED = 103
    """values[0]: status returned; values[1]: 0 read, 1 write."""
    PERIODS_MISSED = 104
    """values[0]: periods missed by the tick that begins an episode of late ticks."""
    LATENESS_OVER = 105
    """End of an episode of more than one late tick: one to two seconds without a missed period, or the end of the run.
    values: periods missed in the episode, number of late ticks, most periods missed by one tick."""


class Origin(IntEnum):
    """Source of a command or event."""

    LOOP = 0
    SCHEDULE = 1
    OPERATOR = 2
    SUPERVISOR = 3
    CAN = 4


def message(
    kind: Kind, *, tick: int = 0, axis: int = ALL_AXES, origin: Origin = Origin.OPERATOR, values: Sequence[float] = ()
) -> npt.NDArray[np.void]:
    """Return one MESSAGE record, shape (1,); its identity and its other values are 0.

    A command of the schedule takes effect from `tick` on, one of the queue at once, whatever its `tick`.

    Raises ValueError for more than MESSAGE_VALUES values.
    """
    record = np.zeros(1, MESSAGE)
    record["tick"], record["kind"], record["axis"], record["origin"] = tick, kind, axis, origin
    record["values"][0, : len(values)] = values
    return record

"""Whether an axis that runs in closed loop is controlled: its drive has room, and its error stays within its band."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from rtloop import signals
from rtloop.foundation.arrays import Real
from rtloop.signals import Mode

if TYPE_CHECKING:
    from rtloop.configuration.axis import LimitsOptions


class Condition(StrEnum):
    """Of an axis in closed loop, over the ticks of half a second."""

    CONTROLLED = "controlled"
    SATURATED = "saturated"
    """In more than half of the ticks the law asked for more than the limits of command or drive."""
    NOT_SETTLED = "not settled"
    """In more than half of the ticks |error| was larger than `settled_within_um`."""


def condition(rows: Real, axis: int, limits: LimitsOptions) -> Condition | None:
    """Condition of axis number `axis` over `rows` (n, columns) of the record; None where it was not in closed loop.

    Ticks in other modes do not count. A slew limit is not judged: it holds the drive up, not down.
    """
    closed_rows = rows[rows[:, signals.MODE] == Mode.CLOSED_LOOP]
    if not len(closed_rows):
        return None
    command_um, demand_v, error_um = (
        closed_rows[:, signals.axis_column(axis, signal)] for signal in (signals.COMMAND, signals.DEMAND, signals.ERROR)
    )
    exceeds_drive = (demand_v > limits.drive_v) | (demand_v < limits.lowest_v)
    if np.mean((np.abs(command_um) > limits.command_um) | exceeds_drive) > 0.5:
        return Condition.SATURATED
    if limits.settled_within_um is not None and np.mean(np.abs(error_um) > limits.settled_within_um) > 0.5:
        return Condition.NOT_SETTLED
    return Condition.CONTROLLED

"""Condition of an axis in closed loop: controlled, saturated or not settled."""

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
    """Condition of an axis in closed loop, over the ticks of half a second."""

    CONTROLLED = "controlled"
    SATURATED = "saturated"
    """The law exceeds the limits of command or drive in more than half of the ticks."""
    NOT_SETTLED = "not settled"
    """|error| exceeds `settled_within_um` in more than half of the ticks."""


def axis_condition(rows: Real, axis: int, limits: LimitsOptions) -> Condition | None:
    """Return the condition of axis number `axis` over the records `rows` (n, columns); None without closed-loop ticks.

    SATURATED if the law demands a command or drive beyond its limits in more than half of the closed-loop ticks, else
    NOT_SETTLED if |error| exceeds `settled_within_um` (None: never) in more than half of them, else CONTROLLED. The
    slew limit does not count: it delays the drive and does not bound it.
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

"""Reference of a configuration that a design writes: steps that the actuator can follow, also to one side alone."""

from __future__ import annotations

import math
from typing import TypedDict

from rtloop.configuration.axis import LimitsOptions
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.reach import reachable_range

STEP_PART, LEAST_DWELL_S = 0.25, 0.1
"""Step as a fraction of the largest command, and the least duration of each level."""


class StepsReference(TypedDict):
    """Table [axis.reference] of a square wave: two levels in µm, the farther from rest first, and their duration."""

    kind: str
    levels: list[float]
    dwell_s: float


def steps_reference(limits: LimitsOptions, actuator: PlayModel, settling_s: float, period_s: float) -> StepsReference:
    """Return [axis.reference]: a square wave between 0 and STEP_PART of the largest command, to one significant digit.

    An actuator that does not come back to 0 within the drive's limits gets a square wave within the positions that it
    does come back to. Each level lasts whole ticks: at least LEAST_DWELL_S, and at least `settling_s`. Its keys are
    `kind`, `levels` (two, in µm, the farther from rest first) and `dwell_s`. Raises ValueError for an actuator without
    inverse.
    """
    dwell_s = math.ceil(max(LEAST_DWELL_S, settling_s) / period_s) * period_s
    levels_um = _levels_um(limits, actuator)
    return {"kind": "steps", "levels": levels_um, "dwell_s": round(dwell_s, 9)}


def describe_reference(values: StepsReference) -> str:
    """Return the table that `steps_reference` makes as words: both levels in µm, and the duration of each in s."""
    levels = " and ".join(f"{level:g}" for level in values["levels"])
    return f"steps between {levels} µm, {values['dwell_s']:g} s each"


def _levels_um(limits: LimitsOptions, actuator: PlayModel) -> list[float]:
    """Return both levels of the square wave in µm, the one farther from rest first."""
    low_um, high_um = reachable_range(actuator, limits.lowest_v, limits.drive_v)
    if low_um <= 0 <= high_um:
        return [float(f"{STEP_PART * limits.command_um:.1g}"), 0.0]
    rest_um = low_um if low_um > 0 else high_um
    step_um = STEP_PART * (math.copysign(limits.command_um, rest_um) - rest_um)
    return [float(f"{rest_um + count * step_um:.2g}") for count in (2, 1)]

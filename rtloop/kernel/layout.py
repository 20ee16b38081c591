"""Coefficients and state of what every axis has, whatever law it runs, as fixed-size records.

Their bytes are what a recording keeps and a replay uses. Behind each record of an axis stand those of its feedforward
and of its controller (`rtloop.kernel.memory`), which are the plug-ins' own.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rtloop.kernel.interlocks import INTERLOCK_FIELDS, INTERLOCK_STATE
from rtloop.kernel.validity import COUNT, SWITCH, Allowed, Bits
from rtloop.signals import TRIP_MASK, Flag, Mode

REVISION = 4
"""Of what the law does with its memory, and of how it is laid out. Up to 2 there was one controller and one
feedforward, within the records of the axes; up to 3 one row of taps."""
MAX_TAPS = 128
TAP_LANES = 4
"""Taps in use are padded with zeros to a multiple of this."""
MAX_SECTIONS = 12
MAX_COUPLED = 8
"""Axes that one controller may have."""
MAX_EXTRAS = 8
"""Inputs, and outputs, beside the sensors and the drives."""
MAX_LAWS = 32
"""Kinds of laws that one loop may know."""
REFILL = -1
"""A tap index that says: fill the pre-filter's memory with the next reference."""

Records = np.recarray[Any, Any]

LINE_BYTES = 64
"""Records begin at a cache line and arrays come first in them: no load of four numbers straddles two lines."""


def cache_line_record(fields: list[Any]) -> np.dtype[Any]:
    """A record of `fields` and what fills up its last cache line."""
    size = np.dtype(fields, align=True).itemsize
    return np.dtype([*fields, ("reserved", np.float64, (-size % LINE_BYTES // 8,))], align=True)


COEFFICIENTS = cache_line_record(
    [
        # reference pre-filter: FIR taps to the error and to the command; then second-order sections b0 b1 b2 a1 a2
        ("taps", np.float64, (MAX_TAPS,)),
        ("command_taps", np.float64, (MAX_TAPS,)),
        ("sections", np.float64, (MAX_SECTIONS, 5)),
        ("resting_error", np.float64, (MAX_COUPLED,)),  # error per command of each axis at which the controller rests
        ("tap_count", np.int64),
        ("section_count", np.int64),
        # numbers of the laws, and how many axes the controller has: 0 for one that an axis before this one owns
        ("feedforward_law", np.uint8),
        ("controller_law", np.uint8),
        ("controller_axes", np.uint8),
        ("unused", np.uint8, (5,)),  # no byte of a record may lie between its fields: copies would leave it undefined
        # sensor scale
        ("um_per_v", np.float64),
        ("offset_v", np.float64),
        # limits; rates are per tick
        ("command_limit_um", np.float64),
        ("drive_min_v", np.float64),
        ("drive_max_v", np.float64),
        ("safe_v", np.float64),
        ("slew_v_per_tick", np.float64),
        ("trip_slew_v_per_tick", np.float64),
        ("bump_decay", np.float64),
        *INTERLOCK_FIELDS,
    ]
)
STATE = cache_line_record(
    [
        ("tap_history", np.float64, (2 * MAX_TAPS,)),  # newest first from `tap_index` on, and all of it twice
        ("tap_sums", np.float64, (2 * TAP_LANES,)),
        ("section_history", np.float64, (MAX_SECTIONS, 2)),
        ("tap_index", np.int64),
        # what makes a new mode, or another controller, go on from where the old one was
        ("bump", np.float64),
        ("command_bump_um", np.float64),
        ("entering", np.int64),
        ("usable", np.int64),
        *INTERLOCK_STATE,
        # a law that failed: which function of which, 0 for none, and what it returned
        ("failed", np.int64),
        ("failed_value", np.float64),
        # signals of the current tick
        ("position_um", np.float64),
        ("error_um", np.float64),
        ("feed_um", np.float64),  # of the command, what comes from the reference and not from the controller
        ("command_um", np.float64),
        ("applied_command_um", np.float64),
        ("demand_v", np.float64),
        ("drive_v", np.float64),
    ]
)
LOOP_STATE = np.dtype(
    [
        *((name, np.int64) for name in ("mode", "trip", "new_trip", "tick_flags", "settled")),
        ("pending", np.int64),
    ],
    align=True,
)
"""State common to all axes: Mode; latched causes and those of this tick, as Flag bits; flags of this tick; 1 when
every output is at its safe value; causes that the end of a tick found, for the next."""
TRIPS = Bits(sum(Flag) & TRIP_MASK)
ALLOWED_COEFFICIENTS = {
    "tap_count": Allowed(0, MAX_TAPS, TAP_LANES),
    "section_count": Allowed(0, MAX_SECTIONS),
    "controller_axes": Allowed(0, MAX_COUPLED),
    **{name: COUNT for name, kind in INTERLOCK_FIELDS if kind is np.int64},
}
"""What whole numbers may be; the numbers of laws depend on how many there are."""
ALLOWED_STATE = {
    "tap_index": Allowed(REFILL, MAX_TAPS - 1),
    "entering": Allowed(0, 2),
    "usable": SWITCH,
    "swing_direction": Allowed(-1, 1),
    **dict.fromkeys(("frozen_count", "tracking_count", "swing_age", "swing_count", "late_count", "failed"), COUNT),
}
ALLOWED_LOOP_STATE = {
    "mode": Allowed(min(Mode), max(Mode)),
    "trip": TRIPS,
    "new_trip": TRIPS,
    "tick_flags": Bits(sum(Flag)),
    "settled": SWITCH,
    "pending": TRIPS,
}
"""What whole numbers may be in records that come from elsewhere."""
CONDITIONS = np.dtype(
    [
        ("driver_status", np.int64),
        ("heartbeat_lost", np.int64),
        ("sample_age_us", np.float64),
        ("lateness_us", np.float64),
        ("enable_v", np.float64),
    ],
    align=True,
)
"""What a tick is judged by beside its inputs; all of it is recorded."""
CONTROL_SIGNALS = ("reference_um", "position_um", "error_um", "command_um", "applied_um")
_EXTRAS = [("inputs", np.float64, (MAX_EXTRAS,)), ("outputs", np.float64, (MAX_EXTRAS,))]
CONTROL = np.dtype([*((name, np.float64) for name in CONTROL_SIGNALS), *_EXTRAS], align=True)
"""What a controller is told of an axis, see `rtloop.laws.contract`; written anew each tick, no part of the state."""


def control_dtype(axes: int) -> np.dtype[Any]:
    """What a controller of so many axes is told: of several, the same, each number an array with an entry an axis."""
    if axes == 1:
        return CONTROL
    return np.dtype([*((name, np.float64, (axes,)) for name in CONTROL_SIGNALS), *_EXTRAS], align=True)


EXTRA_OUTPUT = np.dtype(
    [*((name, np.float64) for name in ("value_v", "lowest_v", "highest_v", "safe_v")), ("axis", np.int64)], align=True
)
"""An output beside the drives: what it is now, where it may be, and which axis's controller sets it."""
FUNCTIONS = np.dtype(
    [
        *((name, np.int64) for name in ("output", "update", "enter")),
        *((name, np.int64) for name in ("axes", "coefficients_bytes", "state_bytes", "first_rule", "rule_count")),
    ],
    align=True,
)
"""A law as the loop calls it: addresses (0 for none), for how many axes (0 for a feedforward), sizes of its records,
and which of the rules are its own."""
RULE = np.dtype(
    [(name, np.int64) for name in ("offset", "octets", "count", "low", "high", "step")],
    align=True,
)
"""What whole numbers at `offset` of a record of coefficients may be, `count` of them with 1 or 8 octets each."""
LAW = np.dtype(
    [
        *((name, np.int64) for name in ("coefficients", "coefficients_bytes", "axes", "axes_bytes", "loop")),
        *((name, np.int64) for name in ("controls", "together", "functions", "rules", "result", "raised", "trip")),
        *((name, np.int64) for name in ("controller_coefficients", "controller_state")),
        *((name, np.int64) for name in ("extra_inputs", "extra_outputs", "extra_count")),
        *((name, np.uint32) for name in ("axis_count", "law_count", "extra_input_count", "extra_output_count")),
    ],
    align=True,
)
"""Where the law of a loop is: addresses of its records and tables, what lies between the records of two axes, and where
the controller's begin within them; the feedforward's begin behind the axis's own."""

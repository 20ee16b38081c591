"""Layout of the fixed-size records of an axis, which are the same for every law: coefficients and state.

A recording stores their bytes and a replay uses them. Each record of an axis is followed by the records of its
feedforward and of its controller (`rtloop.kernel.memory`), whose layout the laws define.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rtloop.kernel.interlocks import INTERLOCK_FIELDS, INTERLOCK_STATE
from rtloop.kernel.validity import COUNT, SWITCH, Allowed, Bits
from rtloop.signals import TRIP_MASK, Flag, Mode

REVISION = 4
"""Revision of the layout and of its meaning. Up to 2, controller and feedforward were fields of the axes' records; up
to 3, there was one row of taps."""
MAX_TAPS = 128
TAP_LANES = 4
"""Taps in use are padded with zeros to a multiple of this."""
MAX_SECTIONS = 12
MAX_COUPLED = 8
"""Maximum number of axes of one controller."""
MAX_EXTRAS = 8
"""Maximum number of extra inputs, and of extra outputs."""
MAX_LAWS = 32
"""Maximum number of laws that a loop has loaded."""
REFILL = -1
"""Value of `tap_index`: the next reference fills the memory of the pre-filter."""

Records = np.recarray[tuple[int, ...], np.dtype[np.record]]

LINE_BYTES = 64
"""Alignment of records. Arrays come first in a record, so that no load of four numbers crosses a cache line."""


def cache_line_record(fields: list[Any]) -> np.dtype[np.void]:
    """Return the type of a record of `fields`, padded to whole cache lines by the field `reserved`."""
    size = np.dtype(fields, align=True).itemsize
    return np.dtype([*fields, ("reserved", np.float64, (-size % LINE_BYTES // 8,))], align=True)


COEFFICIENTS = cache_line_record(
    [
        # reference pre-filter: FIR taps to the error and to the command; then second-order sections b0 b1 b2 a1 a2
        ("taps", np.float64, (MAX_TAPS,)),
        ("command_taps", np.float64, (MAX_TAPS,)),
        ("sections", np.float64, (MAX_SECTIONS, 5)),
        ("resting_error", np.float64, (MAX_COUPLED,)),  # error per command of each axis at rest of the controller
        ("tap_count", np.int64),
        ("section_count", np.int64),
        # numbers of the laws; number of the controller's axes, 0 if a preceding axis has the controller
        ("feedforward_law", np.uint8),
        ("controller_law", np.uint8),
        ("controller_axes", np.uint8),
        ("unused", np.uint8, (5,)),  # no gap between fields: copies would leave its bytes undefined
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
        ("tap_history", np.float64, (2 * MAX_TAPS,)),  # newest first from `tap_index` on, stored twice
        ("tap_sums", np.float64, (2 * TAP_LANES,)),
        ("section_history", np.float64, (MAX_SECTIONS, 2)),
        ("tap_index", np.int64),
        # offsets that make a new mode or controller continue from the output in force
        ("bump", np.float64),
        ("command_bump_um", np.float64),
        ("entering", np.int64),
        ("usable", np.int64),
        *INTERLOCK_STATE,
        # failure of a law: its `Failure` code, 0 for none, and the value returned
        ("failed", np.int64),
        ("failed_value", np.float64),
        # signals of the current tick
        ("position_um", np.float64),
        ("error_um", np.float64),
        ("feed_um", np.float64),  # part of the command that comes from the reference, not from the controller
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
"""State common to all axes. `mode`: Mode; `trip`: latched causes, `new_trip`: causes first found in this tick, both as
Flag bits; `tick_flags`: flags of this tick; `settled`: 1 when every output is at its safe value; `pending`: causes
found at the end of a tick, which trip the next."""
TRIPS = Bits(sum(Flag) & TRIP_MASK)
ALLOWED_COEFFICIENTS = {
    "tap_count": Allowed(0, MAX_TAPS, TAP_LANES),
    "section_count": Allowed(0, MAX_SECTIONS),
    "controller_axes": Allowed(0, MAX_COUPLED),
    **{name: COUNT for name, kind in INTERLOCK_FIELDS if kind is np.int64},
}
"""Allowed values of whole-number coefficients; `Layout` adds the range of law numbers."""
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
"""Allowed values of whole numbers in the state of a loop, checked in records from a file."""
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
"""Quantities besides the inputs that the interlocks of a tick evaluate; all are recorded."""
CONTROL_SIGNALS = ("reference_um", "position_um", "error_um", "command_um", "applied_um")
_EXTRAS = [("inputs", np.float64, (MAX_EXTRAS,)), ("outputs", np.float64, (MAX_EXTRAS,))]
CONTROL = np.dtype([*((name, np.float64) for name in CONTROL_SIGNALS), *_EXTRAS], align=True)
"""Signals of an axis that a controller receives (`rtloop.laws.contract`); set in each tick, not part of the state."""


def control_dtype(axes: int) -> np.dtype[np.void]:
    """Return the type of the signals for a controller of `axes` axes.

    With several axes, each of CONTROL_SIGNALS is an array (axes,); `inputs` and `outputs` stay (MAX_EXTRAS,).
    """
    if axes == 1:
        return CONTROL
    return np.dtype([*((name, np.float64, (axes,)) for name in CONTROL_SIGNALS), *_EXTRAS], align=True)


EXTRA_OUTPUT = np.dtype(
    [
        *((name, np.float64) for name in ("value_v", "lowest_v", "highest_v", "safe_v", "level_um")),
        *((name, np.int64) for name in ("axis", "mark", "is_high")),
    ],
    align=True,
)
"""Extra output: present value, range and safe value in V, and its axis, whose controller sets it unless it is a mark.
`mark` is a Mark, `level_um` the level of Mark.POSITION; `is_high` is 1 in a tick in which the mark is high."""
FUNCTIONS = np.dtype(
    [
        *((name, np.int64) for name in ("output", "update", "enter")),
        *((name, np.int64) for name in ("axes", "coefficients_bytes", "state_bytes", "first_rule", "rule_count")),
    ],
    align=True,
)
"""A law as the loop calls it: addresses of its functions (0 for none), number of its axes (0 for a feedforward), sizes
of its records, and its part of the RULE records."""
RULE = np.dtype(
    [(name, np.int64) for name in ("offset", "octets", "count", "low", "high", "step")],
    align=True,
)
"""Allowed values of `count` whole numbers with 1 or 8 octets each, at `offset` in a record of coefficients."""
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
"""Location of a loop's records: addresses of records and tables, distance in bytes between the records of two axes, and
the controller's offset in them. The feedforward's record follows the axis's."""

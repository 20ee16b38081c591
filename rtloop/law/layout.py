"""Coefficients and state of the law as fixed-size records: their bytes are what a recording keeps and a replay uses.

One record per axis, so that one compiled kernel serves every configuration. Sizes are upper bounds; `*_count` says
how much of an array is in use.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.law.validity import COUNT, SWITCH, Allowed, Bits, require_allowed
from rtloop.signals import TRIP_MASK, Flag, Mode

REVISION = 2
"""Of what the law does with its memory. 1 kept the pre-filter's through changes of mode, and of sections alone."""
LANES = 4
"""Play operators and pairs of controller states are computed four at a time. What is in use is padded to a multiple
of this with zero weights, so that no kernel needs a remainder; counts have 8 bits, so that no index can be negative."""
BLOCK = 2 * LANES
"""Controller states in a block: four, and then the partners of these four."""
MAX_PLAYS = 64
MAX_ORDER = 24
MAX_TAPS = 128
MAX_SECTIONS = 12
ANEW = -1
"""A tap index that says: fill the pre-filter's memory with the next reference."""

Records = np.recarray[Any, Any]

LINE_BYTES = 64
"""Records begin at a cache line and arrays come first in them: no load of four numbers straddles two lines."""


def _whole_lines(fields: list[Any]) -> np.dtype[Any]:
    """A record of `fields` and what fills up its last cache line."""
    size = np.dtype(fields, align=True).itemsize
    return np.dtype([*fields, ("reserved", np.float64, (-size % LINE_BYTES // 8,))], align=True)


COEFFICIENTS = _whole_lines(
    [
        # inverse Prandtl-Ishlinskii and the forward model that it inverts
        ("inverse_thresholds_um", np.float64, (MAX_PLAYS,)),
        ("inverse_weights_v_per_um", np.float64, (MAX_PLAYS,)),
        ("model_thresholds_v", np.float64, (MAX_PLAYS,)),
        ("model_weights_um_per_v", np.float64, (MAX_PLAYS,)),
        # controller C(z): x⁺ = A x + b e, v = c x + d e. States stand in blocks of four pairs, four first ones and
        # then their four partners; A within the pairs is `own` and `partner`, `coupling` holds the rest of A, of
        # whose rows only the columns start ≤ j < stop are non-zero
        ("own", np.float64, (MAX_ORDER,)),
        ("partner", np.float64, (MAX_ORDER,)),
        ("b", np.float64, (MAX_ORDER,)),
        ("c", np.float64, (MAX_ORDER,)),
        ("tracking", np.float64, (MAX_ORDER,)),
        ("steady_state", np.float64, (MAX_ORDER,)),
        ("coupling", np.float64, (MAX_ORDER, MAX_ORDER)),
        # reference pre-filter: FIR taps, then second-order sections b0 b1 b2 a1 a2
        ("taps", np.float64, (MAX_TAPS,)),
        ("sections", np.float64, (MAX_SECTIONS, 5)),
        ("tap_count", np.int64),
        ("section_count", np.int64),
        # plays and controller
        ("play_count", np.uint8),
        ("order", np.uint8),
        ("coupled", np.uint8),
        ("row_start", np.uint8, (MAX_ORDER,)),
        ("row_stop", np.uint8, (MAX_ORDER,)),
        ("unused", np.uint8, (5,)),  # no byte of a record may lie between its fields: copies would leave it undefined
        ("d", np.float64),
        ("tracking_share", np.float64),
        ("resting_error", np.float64),  # error per command at which C stays where it is
        ("dead_band_v", np.float64),
        ("dead_band_threshold_v", np.float64),
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
        # interlocks
        ("sensor_min_v", np.float64),
        ("sensor_max_v", np.float64),
        ("position_limit_um", np.float64),
        ("sample_age_limit_us", np.float64),
        ("enable_min_v", np.float64),
        ("frozen_drive_v", np.float64),
        ("frozen_ticks", np.int64),
        ("tracking_error_um", np.float64),
        ("tracking_ticks", np.int64),
        ("oscillation_um", np.float64),
        ("oscillation_swings", np.int64),
        ("swing_ticks", np.int64),
        ("late_us", np.float64),
        ("late_ticks", np.int64),
    ]
)
STATE = _whole_lines(
    [
        ("inverse_plays_um", np.float64, (MAX_PLAYS,)),
        ("model_plays_v", np.float64, (MAX_PLAYS,)),
        ("controller", np.float64, (MAX_ORDER,)),
        ("scratch", np.float64, (MAX_ORDER,)),
        ("tap_history", np.float64, (MAX_TAPS,)),
        ("section_history", np.float64, (MAX_SECTIONS, 2)),
        ("sums", np.float64, (LANES,)),
        ("tap_index", np.int64),
        ("dead_band_direction", np.float64),
        ("bump", np.float64),
        ("entering", np.int64),
        ("usable", np.int64),
        # interlocks with memory
        ("frozen_adc_v", np.float64),
        ("frozen_from_v", np.float64),
        ("frozen_count", np.int64),
        ("tracking_count", np.int64),
        ("swing_extreme_um", np.float64),
        ("swing_direction", np.int64),
        ("swing_age", np.int64),
        ("swing_count", np.int64),
        ("late_count", np.int64),
        # signals of the current tick
        ("position_um", np.float64),
        ("error_um", np.float64),
        ("command_um", np.float64),
        ("applied_command_um", np.float64),
        ("demand_v", np.float64),
        ("drive_v", np.float64),
    ]
)
LOOP_STATE = np.dtype(
    [("mode", np.int64), ("trip", np.int64), ("new_trip", np.int64), ("tick_flags", np.int64), ("settled", np.int64)],
    align=True,
)
"""State common to all axes: Mode; latched causes and those of this tick, as Flag bits; flags of this tick; 1 when
every output is at its safe value."""
TRIPS = Bits(sum(Flag) & TRIP_MASK)
ALLOWED_COEFFICIENTS = {
    "tap_count": Allowed(0, MAX_TAPS),
    "section_count": Allowed(0, MAX_SECTIONS),
    "play_count": Allowed(0, MAX_PLAYS, LANES),
    "order": Allowed(0, MAX_ORDER, BLOCK),
    "coupled": SWITCH,
    "row_start": Allowed(0, MAX_ORDER),
    "row_stop": Allowed(0, MAX_ORDER),
    **dict.fromkeys(("frozen_ticks", "tracking_ticks", "oscillation_swings", "swing_ticks", "late_ticks"), COUNT),
}
ALLOWED_STATE = {
    "entering": Allowed(0, 2),
    "usable": SWITCH,
    "swing_direction": Allowed(-1, 1),
    **dict.fromkeys(("frozen_count", "tracking_count", "swing_age", "swing_count", "late_count"), COUNT),
}
ALLOWED_LOOP_STATE = {
    "mode": Allowed(min(Mode), max(Mode)),
    "trip": TRIPS,
    "new_trip": TRIPS,
    "tick_flags": Bits(sum(Flag)),
    "settled": SWITCH,
}
"""What whole numbers may be in records that come from elsewhere; of `tap_index`, see `split_snapshot`."""
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


def records(dtype: np.dtype[Any], count: int) -> Records:
    """Zeroed records at a cache line, with attribute access also where the kernels run uncompiled."""
    room = np.zeros(count * dtype.itemsize + LINE_BYTES, np.uint8)
    begin = -room.ctypes.data % LINE_BYTES
    return room[begin : begin + count * dtype.itemsize].view(dtype).view(np.recarray)


def copied(source: npt.NDArray[Any]) -> Records:
    """A copy of records, at a cache line."""
    copy = records(source.dtype, source.size)
    copy[:] = source
    return copy


def initial_state(coefficients: Records) -> tuple[Records, Records]:
    """State of (axes, loop) at rest: outputs at their safe values, an unloaded actuator that never moved."""
    axes = records(STATE, coefficients.size)
    axes["drive_v"] = coefficients["safe_v"]
    return axes, records(LOOP_STATE, 1)


def snapshot_bytes(axes: int) -> int:
    """Length of a snapshot: tick, coefficients and state."""
    return 8 + axes * (COEFFICIENTS.itemsize + STATE.itemsize) + LOOP_STATE.itemsize


def split_snapshot(snapshot: bytes | npt.NDArray[np.uint8], axes: int) -> tuple[int, Records, Records, Records]:
    """Tick, coefficients, axes' state and loop state of a snapshot, as copies that the kernels can work on.

    Raises ValueError where the length does not fit `axes`, or a count, an index or a switch is not allowed; a
    `tap_index` of -1 says that the taps are still to be filled.
    """
    data = bytes(snapshot)
    if len(data) != snapshot_bytes(axes):
        raise ValueError(f"law snapshot: {len(data)} bytes, but {axes} axes take {snapshot_bytes(axes)}")
    offset, parts = 8, []
    for dtype, count in ((COEFFICIENTS, axes), (STATE, axes), (LOOP_STATE, 1)):
        parts.append(copied(np.frombuffer(data, dtype, count, offset)))
        offset += count * dtype.itemsize
    coefficients, states, loop = parts
    for number, (axis, state) in enumerate(zip(coefficients, states, strict=True)):
        require_allowed(f"axis {number}", axis, ALLOWED_COEFFICIENTS)
        taps = Allowed(-1, max(int(axis["tap_count"]), 1) - 1)
        require_allowed(f"axis {number}", state, {**ALLOWED_STATE, "tap_index": taps})
    require_allowed("the loop", loop[0], ALLOWED_LOOP_STATE)
    return int.from_bytes(data[:8], "little"), coefficients, states, loop


def layout_description() -> dict[str, Any]:
    """What a recording says of the snapshot's layout: the fields with their offsets, and a digest of them."""
    tables = {"coefficients": COEFFICIENTS, "state": STATE, "loop_state": LOOP_STATE}
    described = {name: np.lib.format.dtype_to_descr(dtype) for name, dtype in tables.items()}
    return {**described, "sha256": hashlib.sha256(repr(described).encode()).hexdigest(), "revision": REVISION}

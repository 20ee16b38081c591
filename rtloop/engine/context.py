"""Context of the loop: one record with the addresses of all data of a tick, the settings and the counters.

Compiled code passes a record as a bare pointer. Arrays passed instead would have their reference counts raised and
lowered, atomically, at every call: measured at 2 µs a tick.
"""

from __future__ import annotations

import numpy as np

from rtloop.engine.messages import MESSAGE
from rtloop.engine.ring import Ring
from rtloop.foundation.native.compiled import jit
from rtloop.foundation.native.pointers import address_pointer, carray
from rtloop.kernel.layout import CONDITIONS, LAW
from rtloop.kernel.reference import GENERATOR

WORDS = 64
_ADDRESSES = (
    # C functions and their contexts
    *("read", "write", "driver_context", "wait", "wait_context", "now", "clock_context"),
    # buffers that the driver and the clock fill or read
    *("inputs", "outputs", "timing"),
    # law
    *("law", "generators", "table", "adc_v", "references", "feeds_um", "input_index", "output_index"),
    *("conditions", "extra_input_index", "extra_output_index", "heart_text"),
    # shared block
    *("words", "last_drive_v", "commands", "commands_marks", "schedule", "staged"),
    *(f"{ring}_{part}" for ring in ("ticks", "events", "snapshots") for part in ("head", "marks", "slots")),
)
# of 32 bits and unsigned: sums of them are never negative, so that no index needs a check of its sign
_COUNTS = (
    *("axis_count", "input_count", "output_count", "observed_count", "table_count", "command_count", "schedule_count"),
    *("ticks_capacity", "events_capacity", "snapshots_capacity", "column_count", "snapshot_bytes"),
)
_SETTINGS = (
    ("enable_index", np.int64),
    ("hold_index", np.int64),
    ("hold_min_v", np.float64),
    ("hold_while_high", np.int64),
    ("period_s", np.float64),
    ("period_us", np.float64),
    ("heartbeat_timeout_ns", np.float64),
    ("heart_fd", np.int32),
    ("snapshot_ticks", np.int64),
    ("record_limit", np.int64),
)
_COUNTERS = (
    "tick",
    "events",
    "snapshots",
    "scheduled",
    "stopping",
    "failed",
    "failed_tick",
    "failed_status",
    "refused",
    "late_until",
    "late_ticks",
    "late_periods",
    "late_largest",
    "next_snapshot",
    "silence",
)

LOOP = np.dtype(
    [
        *((name, np.int64) for name in _ADDRESSES),
        *((name, np.uint32) for name in _COUNTS),
        *_SETTINGS,
        *((name, np.int64) for name in _COUNTERS),
        *((name, np.float64) for name in ("next_look_ns", "silence_s")),
    ],
    align=True,
)


@jit
def law_record(loop):
    """Return the LAW record of the loop, a view: the addresses of coefficients, states and functions."""
    return carray(address_pointer(loop.law), 1, LAW)[0]


@jit
def tick_conditions(loop):
    """Return the CONDITIONS record of this tick, which the interlocks evaluate: status of the read, lost heartbeat,
    sample age, lateness, enable voltage.
    """
    return carray(address_pointer(loop.conditions), 1, CONDITIONS)[0]


@jit
def loop_record(address):
    """Return the LOOP record at an address."""
    return carray(address_pointer(address), 1, LOOP)[0]


@jit
def axis_generators(loop):
    """Return the reference generators of all axes, a view of GENERATOR records (axes,)."""
    return carray(address_pointer(loop.generators), loop.axis_count, GENERATOR)


@jit
def control_words(loop):
    """Return the control words of the shared block, a view (WORDS,) of uint64."""
    return carray(address_pointer(loop.words), WORDS, np.uint64)


@jit
def float_array(address, count):
    """Return a view of `count` float64 values at an address."""
    return carray(address_pointer(address), count, np.float64)


@jit
def int_array(address, count):
    """Return a view of `count` int64 values at an address."""
    return carray(address_pointer(address), count, np.int64)


@jit
def word_array(address, count):
    """Return a view of `count` uint64 values at an address."""
    return carray(address_pointer(address), count, np.uint64)


@jit
def message_array(address, count):
    """Return a view of `count` commands or events, MESSAGE records, at an address."""
    return carray(address_pointer(address), count, MESSAGE)


@jit
def tick_ring(loop):
    """Return the ring of tick records, rows of float64."""
    return Ring(
        carray(address_pointer(loop.ticks_head), 1, np.uint64),
        carray(address_pointer(loop.ticks_marks), loop.ticks_capacity, np.uint64),
        carray(address_pointer(loop.ticks_slots), (loop.ticks_capacity, loop.column_count), np.float64),
    )


@jit
def event_ring(loop):
    """Return the Ring of events: views of its head, its marks and its slots, which are MESSAGE records."""
    return Ring(
        carray(address_pointer(loop.events_head), 1, np.uint64),
        carray(address_pointer(loop.events_marks), loop.events_capacity, np.uint64),
        carray(address_pointer(loop.events_slots), loop.events_capacity, MESSAGE),
    )


@jit
def snapshot_ring(loop):
    """Return the ring of the law's snapshots, rows of bytes."""
    return Ring(
        carray(address_pointer(loop.snapshots_head), 1, np.uint64),
        carray(address_pointer(loop.snapshots_marks), loop.snapshots_capacity, np.uint64),
        carray(address_pointer(loop.snapshots_slots), (loop.snapshots_capacity, loop.snapshot_bytes), np.uint8),
    )

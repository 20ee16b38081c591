"""Record of a tick: the definition that ring, recording, replay and export share.

A record is a row of float64. Its columns are the common signals, the signals of each axis, extra inputs and outputs in
volts, and the signals that the driver declares as observed (a rig's truth; recorded, never passed to the law).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum, IntFlag
from typing import NamedTuple, Self, TypedDict


class Signal(NamedTuple):
    """Column of the record of a tick; `unit` is "1" for a number without a unit."""

    name: str
    unit: str
    meaning: str


VALUE_AND_LIMIT = "{cause} {value:.6g}{unit}, its limit {limit:g}{unit}"
"""Message of a trip whose value left its limit."""

COMMON_SIGNALS = (
    Signal("tick", "1", "index of the executed tick, from 0"),
    Signal("deadline_ns", "ns", "time at which the tick was due, since the start of the run"),
    Signal("lateness_us", "µs", "time from the deadline to the wake; NaN in virtual time without simulated lateness"),
    Signal("read_us", "µs", "duration of the driver's read; NaN in virtual time"),
    Signal("law_us", "µs", "time from the end of the read to the start of the write; NaN in virtual time"),
    Signal("write_us", "µs", "duration of the driver's write; NaN in virtual time"),
    Signal("exec_us", "µs", "time from the wake to the end of the tick; NaN in virtual time"),
    Signal("periods_missed", "1", "whole periods that were skipped before this tick"),
    Signal("flags", "1", "bits of Flag"),
    Signal("mode", "1", "number of the loop's Mode during the tick"),
    Signal("driver_status", "1", "return value of the driver's read: 0 good, above 0 degraded, below 0 failed"),
    Signal("sample_age_us", "µs", "age of the sample as the driver states it; 0: the read itself took the sample"),
    Signal("enable_v", "V", "voltage of the enable input; 0 if there is no enable input"),
)
AXIS_SIGNALS = (
    Signal("adc_v", "V", "voltage of the input"),
    Signal("position_um", "µm", "measured position x"),
    Signal("reference_um", "µm", "reference x_d before the pre-filter; volts in raw mode"),
    Signal("error_um", "µm", "error e: pre-filtered reference minus position"),
    Signal("command_um", "µm", "command v to the inverse hysteresis, before its limit"),
    Signal("demand_v", "V", "drive that the law asks for, before the limits of voltage and slew rate"),
    Signal("drive_v", "V", "drive u written to the driver"),
    Signal("feed_um", "µm", "second column of a table reference, added to the command v in closed loop; 0 if missing"),
)
(
    TICK,
    DEADLINE,
    LATENESS,
    READ,
    LAW,
    WRITE,
    EXEC,
    PERIODS_MISSED,
    FLAGS,
    MODE,
    DRIVER_STATUS,
    SAMPLE_AGE,
    ENABLE,
) = range(len(COMMON_SIGNALS))
ADC, POSITION, REFERENCE, ERROR, COMMAND, DEMAND, DRIVE, FEED = range(len(AXIS_SIGNALS))
MEASURED_COLUMNS = (LATENESS, READ, LAW, WRITE, EXEC)
"""Columns measured by a clock, on which no output depends; the flag OVERRUN is measured as well."""
COMMON_COUNT = len(COMMON_SIGNALS)
PER_AXIS_COUNT = len(AXIS_SIGNALS)


class Mode(IntEnum):
    """Source of the outputs. `reference` is in volts in RAW, in µm in FEEDFORWARD and CLOSED_LOOP."""

    OFF = 0
    """The outputs ramp to their safe values and stay there."""
    RAW = 1
    """The reference is the demand."""
    FEEDFORWARD = 2
    """The reference is the command of the feedforward."""
    CLOSED_LOOP = 3
    """The controller sets the command."""


class Flag(IntFlag):
    """Bits of the `flags` signal; bits from 8 upward are the latched trip causes.

    A trip cause has the unit of the value that tripped, and the message of its event, filled in with `cause`, `value`,
    `limit` and `unit`. Its condition is in `rtloop.kernel.interlocks`.
    """

    unit: str
    message: str

    def __new__(cls, bit: int, unit: str = "", message: str = VALUE_AND_LIMIT) -> Self:
        """Make a member with its unit and message."""
        flag = int.__new__(cls, bit)
        flag._value_, flag.unit, flag.message = bit, unit, message
        return flag

    OVERRUN = 1 << 0
    """Lateness and execution together took longer than a period."""
    COMMAND_LIMITED = 1 << 1
    """A command was beyond its limit."""
    DRIVE_LIMITED = 1 << 2
    """A demand was beyond the limits of the drive."""
    SLEW_LIMITED = 1 << 3
    """A drive would have moved by more than the slew rate allows."""
    RAMPING = 1 << 4
    """A drive is on its way to its safe value, or held in the tick of a trip."""
    HEARTBEAT_LOST = 1 << 5
    """The supervisor's heartbeat is older than its timeout."""
    WRITE_FAILED = 1 << 6
    """The driver's write returned a failure."""
    TRIP_NON_FINITE = 1 << 8, " V", "{cause} {value:.6g}{unit}"
    TRIP_SENSOR_RANGE = 1 << 9, " V"
    TRIP_POSITION = 1 << 10, " µm"
    TRIP_DRIVER = 1 << 11
    TRIP_HEARTBEAT = 1 << 12
    TRIP_STALE = 1 << 13, " µs"
    TRIP_FROZEN = 1 << 14, " ticks"
    TRIP_TRACKING = 1 << 15, " µm"
    TRIP_OSCILLATION = 1 << 16, " swings"
    TRIP_LATE = 1 << 17, " µs"
    TRIP_ENABLE = 1 << 18, " V"
    TRIP_LAW = 1 << 19


class Silence(IntEnum):
    """Cause of a lost heartbeat, in the event of its trip."""

    UNKNOWN = 0
    """The supervisor's state could not be read, or an older version recorded the trip."""
    DEAD = 1
    STOPPED = 2
    """A signal or a debugger stopped the supervisor."""
    UNWATCHED = 3
    """The supervisor's process lives, but its watch of the loop stands still."""
    STARVED = 4
    """The supervisor was ready to run, and the host gave it no processor for several timeouts."""


class Failure(IntEnum):
    """Code of the law's function that failed and tripped the loop; RAISED is added if it raised an exception."""

    CONTROLLER_OUTPUT = 2
    CONTROLLER_UPDATE = 4
    CONTROLLER_ENTER = 6
    FEEDFORWARD_OUTPUT = 8
    FEEDFORWARD_UPDATE = 10
    FEEDFORWARD_ENTER = 12


RAISED = 1
"""Added to a `Failure` code if the function raised an exception instead of returning a value."""
TRIP_MASK = ~0xFF & 0xFFFFFFFF
"""The bits of `Flag` that are trip causes."""


def column_names(axes: Sequence[str], observed: Sequence[str], extras: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of a record's columns in order: common signals, signals of each axis, `extras`, `observed`.

    `axes` are names such as "x", whose signals are `x_adc_v`, …; `extras` and `observed` are whole names.
    """
    return (
        *(signal.name for signal in COMMON_SIGNALS),
        *(f"{axis}_{signal.name}" for axis in axes for signal in AXIS_SIGNALS),
        *extras,
        *observed,
    )


def axis_column(axis: int, signal: int) -> int:
    """Return the index of the record's column with signal number `signal` (ADC … FEED) of axis number `axis`."""
    return COMMON_COUNT + axis * PER_AXIS_COUNT + signal


class Trip(TypedDict):
    """Tick of a trip, and the names of its causes."""

    tick: int
    causes: list[str]


def trip_causes(flags: float) -> list[str]:
    """Return the names of the trip causes in a value of `flags`, in lower case without TRIP_; [] for none."""
    bits = int(flags) & TRIP_MASK
    return [flag.name.removeprefix("TRIP_").lower() for flag in Flag if flag & bits and flag.name]

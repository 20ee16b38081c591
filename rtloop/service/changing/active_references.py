"""References that the running loop really has, from its records and events.

The loop alone decides on its references: a mode change into or out of raw replaces a reference by a constant in the
other unit, a schedule sets references, and a command that the loop did not confirm may take effect later. The rules
stand in `rtloop.engine.commands`; the events are followed from the first one on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop import signals
from rtloop.engine.messages import MESSAGE, Kind, Origin
from rtloop.engine.plan import Plan
from rtloop.engine.ring import drain
from rtloop.foundation import timing
from rtloop.kernel.reference import GENERATOR_PARAMETERS, Generator
from rtloop.service.changing.staging import Staging
from rtloop.service.desk import ANSWER_PERIODS, ANSWER_TIMEOUT_S, POLL_S, Refusal
from rtloop.signals import Flag, Mode

EVENTS_AT_ONCE = 64


class ActiveReference(NamedTuple):
    """Reference of one axis: kind of its generator (None: unknown), whether it is in V (else µm), its newest value."""

    kind: Generator | None
    in_volts: bool
    value: float


class Trip(NamedTuple):
    """Newest trip, or failure of the driver, of a loop."""

    number: int
    """1 for the first trip; further causes of a latched trip are the same trip."""
    mode: Mode | None
    """Mode that the trip ended; None if unknown."""
    tick: int
    first_causes: int
    """Causes in the tick of the trip, as bits of Flag; TRIP_DRIVER also for a failed write."""
    causes: int
    """First causes, and the causes that followed while the trip was latched."""
    is_stopped: bool
    """Whether a client has requested mode off since the trip."""


NO_TRIP = Trip(0, Mode.OFF, 0, 0, 0, False)


class ActiveReferences:
    """References of the axes in the loop of `staging`, which began with `plan`. Thread-safe."""

    def __init__(self, plan: Plan, staging: Staging) -> None:
        """Begin with the mode and references of `plan`; no event is read before a call of `follow` or `newest`.

        `staging` gives access to the loop's events and its newest record.
        """
        self._staging, self._period_s = staging, 1.0 / plan.pacing.rate_hz
        self._lock = timing.lock()
        self._cursor = 0
        self._events: npt.NDArray[np.void] = np.zeros(EVENTS_AT_ONCE, MESSAGE)
        self._mode: Mode | None = plan.mode
        """The loop's mode after the last event that was read; None if unknown."""
        self._kinds: list[Generator | None] = [Generator(int(kind)) for kind in plan.generators["kind"]]
        self._in_volts = [bool(volts) for volts in plan.generators["volts"]]
        self._since_ticks = [0] * len(plan.axes)
        """First tick of each reference."""
        self._values: list[tuple[float, ...] | None] = [
            (float(generator["kind"]), *generator["parameters"].tolist()) for generator in plan.generators
        ]
        """[kind, *parameters] of each generator; None for a constant that only the records show."""
        self._trip, self._is_latched = NO_TRIP, False

    def follow(self) -> None:
        """Read the loop's new events, and apply them to references, mode and trip.

        If events were overwritten before they were read, the mode is unknown until the next event that changes it, and
        each reference is unknown until an event sets it while the mode is known.
        """
        ring = self._staging.block.ring("events")
        with self._lock:
            event_count = len(self._events)
            while event_count == len(self._events):
                event_count, first, lost = drain(ring, self._cursor, self._events)
                self._cursor = first + event_count
                if lost:
                    self._mode, self._kinds = None, [None] * len(self._kinds)
                    self._is_latched = False
                for event in self._events[:event_count]:
                    self._apply_event(event)

    @property
    def trip(self) -> Trip:
        """The newest trip in the events that were read; NO_TRIP before the first one."""
        with self._lock:
            return self._trip

    def values(self, number: int) -> tuple[tuple[float, ...], bool] | None:
        """Return ((kind, *parameters) of the generator of axis `number`, whether it is in V); None if it is unknown.

        After a mode change into or out of raw, only the records show the new constant: it is unknown until the loop has
        executed the tick of the change. Uses the events that `follow` has read, and does not wait for the loop.
        """
        record = self._staging.newest_record
        with self._lock:
            values, in_volts, since_tick = self._values[number], self._in_volts[number], self._since_ticks[number]
            if self._kinds[number] is None:
                return None
        if values is not None:
            return values, in_volts
        if record is None or record[signals.TICK] < since_tick:
            return None
        return (float(Generator.HOLD), float(record[signals.axis_column(number, signals.REFERENCE)])), in_volts

    def newest(self, number: int) -> ActiveReference:
        """Return the reference of axis `number` in the newest tick that the loop executed; `kind` None: unknown.

        First waits until the loop has executed the first tick of this reference. Raises Refusal if the loop has not
        done so after ANSWER_TIMEOUT_S and ANSWER_PERIODS periods.
        """
        deadline_s = timing.monotonic_s() + ANSWER_TIMEOUT_S + ANSWER_PERIODS * self._period_s
        while True:
            record = self._staging.newest_record  # Read first: the loop publishes a tick's events before its record.
            self.follow()
            with self._lock:
                kind, in_volts = self._kinds[number], self._in_volts[number]
                since_tick = self._since_ticks[number]
            if record is not None and record[signals.TICK] >= since_tick:
                return ActiveReference(kind, in_volts, float(record[signals.axis_column(number, signals.REFERENCE)]))
            if timing.monotonic_s() > deadline_s:
                raise Refusal("the loop stands still after a change of the reference; try again when the loop runs")
            timing.sleep(POLL_S)

    def _apply_event(self, event: np.void) -> None:
        """Apply one event, a MESSAGE record, to mode, references and trip; the lock must be held."""
        kind, tick, values = int(event["kind"]), int(event["tick"]), event["values"]
        if kind == Kind.SET_MODE:
            self._mode = Mode(int(values[0]))
            if self._mode is not Mode.OFF:
                self._change_units(self._mode is Mode.RAW, bool(values[2]), tick)
        elif kind == Kind.SET_REFERENCE:
            for axis in range(len(self._kinds)):
                if event["axis"] < 0 or event["axis"] == axis:
                    self._kinds[axis] = None if self._mode is None else Generator(int(values[0]))
                    self._values[axis] = tuple(float(value) for value in values[: 1 + GENERATOR_PARAMETERS])
                    self._in_volts[axis], self._since_ticks[axis] = self._mode is Mode.RAW, tick
        elif kind in (Kind.TRIPPED, Kind.DRIVER_FAILED):
            self._record_trip(tick, int(values[0]) if kind == Kind.TRIPPED else int(Flag.TRIP_DRIVER))
        elif kind == Kind.REFUSED:
            is_stop = values[0] == Kind.SET_MODE and values[1] == Mode.OFF
            if is_stop and event["origin"] != Origin.SUPERVISOR:
                self._trip = self._trip._replace(is_stopped=True)
        elif kind in (Kind.RESET_TRIP, Kind.STOP):
            self._is_latched = self._is_latched and kind != Kind.RESET_TRIP
            self._mode = Mode.OFF

    def _record_trip(self, tick: int, causes: int) -> None:
        """Record a trip at `tick`, or, while a trip is latched, its further causes; the lock must be held.

        `causes` are bits of Flag. The mode is off afterwards.
        """
        if not self._is_latched:
            self._trip = Trip(self._trip.number + 1, self._mode, tick, causes, causes, False)
        first = self._trip.first_causes | (causes if tick == self._trip.tick else 0)
        self._trip = self._trip._replace(first_causes=first, causes=self._trip.causes | causes)
        self._mode, self._is_latched = Mode.OFF, True

    def _change_units(self, to_volts: bool, holds_output: bool, tick: int) -> None:
        """Set the unit of all references, V or µm, from `tick` on; the lock must be held.

        With `holds_output`, a reference in the former unit becomes a constant, which holds the output; else its kind
        stays.
        """
        for axis, kind in enumerate(self._kinds):
            if self._in_volts[axis] != to_volts:
                if holds_output and kind is not None:
                    self._kinds[axis], self._values[axis] = Generator.HOLD, None
                self._in_volts[axis], self._since_ticks[axis] = to_volts, tick

"""The return to the state before a trip: reset, depolarise, enter the mode where the axes stand, then move by a ramp.

The mode is entered with the present position (command, drive) as reference, so the drive does not move. A raised
cosine then takes each reference to the first value of the former one, so slowly that the drive stays within
`trip_slew_v_per_s`; the former reference begins where the cosine ends.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from typing import NamedTuple

import numpy as np

from rtloop import signals
from rtloop.configuration.service import DepolariseOptions
from rtloop.engine.messages import Kind
from rtloop.foundation import timing
from rtloop.foundation.arrays import Real
from rtloop.kernel.reference import Generator
from rtloop.service.changing.live import LiveLaw
from rtloop.service.changing.references import ReferenceReplaced, Setting
from rtloop.service.desk import Desk, Refusal
from rtloop.service.preparation import await_ticks, depolarise
from rtloop.service.recovering.former_state import FormerState
from rtloop.signals import Mode
from rtloop.supervision.supervisor import Supervisor

RAMP_FACTOR = 10.0
"""Duration of the cosine as a multiple of the trip ramp's over the whole drive. Its steepest part is pi/2 steeper than
its mean, and the inverse of a hysteresis is steeper than its mean where it turns back: six times are allowed for."""
BUMP_FACTOR = 10.0
"""Least duration of the cosine as a multiple of `limits.bump_s`, in which a mode's entry dies out."""
MAX_SAMPLES = 10_000
"""Most samples of a cosine; a longer one holds each sample for some ticks."""
HELD_COLUMNS = {Mode.RAW: signals.DRIVE, Mode.FEEDFORWARD: signals.COMMAND, Mode.CLOSED_LOOP: signals.POSITION}
"""Signal whose newest value, as a constant reference, lets a mode begin without moving the drive."""
RECORD_TIMEOUT_S = 1.0
POLL_S = 0.002


class ReturnStep(Enum):
    """Step of a return that was taken."""

    RESET = "the trip is reset"
    DEPOLARISED = "the actuator is depolarised"
    ENTERED = "the former mode is entered"


class RunningLoop(NamedTuple):
    """A loop that executes ticks: its supervisor, its law and its desk."""

    supervisor: Supervisor
    live: LiveLaw
    desk: Desk


def raised_cosine(start: float, end: float, count: int) -> Real:
    """Return `count` samples, 2 or more, from `start` to `end` with horizontal tangents at both ends."""
    return start + (end - start) * 0.5 * (1.0 - np.cos(np.pi * np.arange(count) / (count - 1)))


def ramp_ticks(live: LiveLaw) -> int:
    """Return the duration in ticks, at least 2, of the ramp to the former references; the slowest axis determines it
    for all axes.
    """
    plan, durations_s = live.prepared.plan, []
    safe_v = np.asarray(plan.coefficients)["safe_v"]
    for number, axis in enumerate(live.prepared.configuration.axes):
        limits = axis.limits
        travel_v = max(limits.drive_v - safe_v[number], safe_v[number] - limits.lowest_v)
        durations_s += [RAMP_FACTOR * travel_v / limits.trip_slew_v_per_s, BUMP_FACTOR * limits.bump_s]
    return max(2, round(max(durations_s) * plan.pacing.rate_hz))


def come_back(
    former: FormerState, loop: RunningLoop, sine: DepolariseOptions | None, on_step: Callable[[ReturnStep], None]
) -> None:
    """Reset the trip, set the mode of `former`, and move to its references by a ramp; wait until that is done.

    The caller's requester sends all commands. `sine`, unless it is None, depolarises after the reset; `on_step` is
    called after each step. Raises Refusal after another trip and for an unknown reference, ReferenceReplaced if a
    client sets a reference, and as `Desk.submit`. What was done before the error, such as the reset or the mode, stays.
    """
    supervisor, live, desk = loop
    desk.submit(Kind.RESET_TRIP)
    on_step(ReturnStep.RESET)
    if sine is not None:
        depolarise(sine, supervisor, live, desk)
        on_step(ReturnStep.DEPOLARISED)
    targets = [_restart(former, number, loop) for number in range(len(former.settings))]
    present = [_hold_present(former, number, loop, former.mode) for number in range(len(targets))]
    desk.submit(Kind.SET_MODE, values=[float(former.mode), 0.0, 1.0])
    on_step(ReturnStep.ENTERED)
    ticks = ramp_ticks(live)
    hold_ticks = -(-ticks // MAX_SAMPLES)
    for number, (start, (end, feed_um)) in enumerate(zip(present, targets, strict=True)):
        count = max(2, -(-ticks // hold_ticks))
        columns = [raised_cosine(start, end, count), *([raised_cosine(0.0, feed_um, count)] if feed_um else [])]
        live.references.play_once(number, np.stack(columns, axis=1), hold_ticks, former.client_counts[number])
    await_ticks(supervisor, ticks + hold_ticks, live.prepared.plan.pacing.rate_hz)
    for number in range(len(targets)):
        _restart(former, number, loop)


def restore_references(former: FormerState, mode: Mode, loop: RunningLoop) -> None:
    """Start the references of `former` again, which a return that did not succeed has replaced.

    Call it before another mode than raw is entered, for raw after it. A former reference in the unit of another mode
    becomes a constant, as when the mode changes. A reference that a client has set since stays. Raises as
    `LiveReferences.restart`.
    """
    is_raw = mode is Mode.RAW
    for number, setting in enumerate(former.settings):
        with suppress(ReferenceReplaced):
            if setting is not None and setting.in_volts == is_raw:
                loop.live.references.restart(number, setting, former.client_counts[number])
            elif not is_raw:
                _hold_present(former, number, loop, mode)


def _restart(former: FormerState, number: int, loop: RunningLoop) -> tuple[float, float]:
    """Start the former reference of axis `number` from its beginning, and wait for its first tick.

    Returns (first value, µm or in raw mode V; first addition to the command, µm). Raises as `come_back`.
    """
    setting = former.settings[number]
    if setting is None:
        raise Refusal(
            f"reference of axis {loop.live.prepared.plan.axes[number]}: unknown, so the service cannot return to it"
        )
    tick = loop.live.references.restart(number, setting, former.client_counts[number])
    record = _await_record(loop.supervisor, tick)
    return (
        float(record[signals.axis_column(number, signals.REFERENCE)]),
        float(record[signals.axis_column(number, signals.FEED)]),
    )


def _hold_present(former: FormerState, number: int, loop: RunningLoop, mode: Mode) -> float:
    """Set a constant reference of axis `number` with which entering `mode` does not move the drive, and return its
    value, µm or in raw mode V.

    The value is the newest one of the mode's signal in HELD_COLUMNS. Raises as `LiveReferences.restart`.
    """
    value = float(loop.supervisor.newest(1)[-1, signals.axis_column(number, HELD_COLUMNS[mode])])
    hold = Setting((float(Generator.HOLD), value), mode is Mode.RAW)
    loop.live.references.restart(number, hold, former.client_counts[number])
    return value


def _await_record(supervisor: Supervisor, tick: int) -> Real:
    """Wait for the record of `tick`, a tick that the loop has just executed or executes soon, and return it (columns,).

    Raises Refusal after RECORD_TIMEOUT_S without this record.
    """
    deadline_s = timing.monotonic_s() + RECORD_TIMEOUT_S
    is_late = False
    while not is_late:
        is_late = timing.monotonic_s() >= deadline_s  # read first: a stalled service looks once more
        rows = supervisor.newest(max(supervisor.ticks - tick, 1))
        match = rows[rows[:, signals.TICK] == tick]
        if len(match):
            return match[0]
        timing.sleep(POLL_S)
    raise Refusal(
        f"the service found no record of tick {tick} within {RECORD_TIMEOUT_S:g} s; the loop stands still, or the host "
        "is overloaded; see `rtloop doctor`"
    )

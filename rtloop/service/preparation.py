"""Preparation of the actuator: erase its hysteresis memory with a decaying sine, then tare its position."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rtloop import signals
from rtloop.configuration.service import DepolariseOptions, ServiceOptions
from rtloop.engine.messages import Kind
from rtloop.foundation import timing
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Desk, Refusal
from rtloop.signals import Flag, Mode
from rtloop.supervision.supervisor import Supervisor

POLL_S = 0.01
TIMEOUT_FACTOR = 3.0
"""A step of the preparation may take this multiple of its nominal time, plus 1 s."""


def prepare_actuator(options: ServiceOptions, supervisor: Supervisor, live: LiveLaw, desk: Desk) -> None:
    """Prepare the actuators as `options` say: erase the hysteresis of all axes by a decaying sine (`depolarise`), then
    make the present mean reading of each axis its position 0 (tare).

    Waits until that is done; the outputs are then at their safe values. Raises Refusal after a trip and if the loop
    executes no ticks in time, and as `LiveReferences.play_raw`, `LiveLaw.tare` and `Desk.submit`; what was done before
    the error stays, as in `depolarise`.
    """
    axes = range(len(live.prepared.plan.axes))
    if options.depolarise is not None:
        depolarise(options.depolarise, supervisor, live, desk)
    if options.tare_s > 0:
        count = max(1, round(options.tare_s * live.prepared.plan.pacing.rate_hz))
        for axis, offset_v in enumerate(_mean_inputs_v(supervisor, count, len(axes))):
            live.tare(axis, offset_v)


def depolarise(options: DepolariseOptions, supervisor: Supervisor, live: LiveLaw, desk: Desk) -> None:
    """Erase the hysteresis of all axes by the same decaying sine of the drive, in mode raw, then set mode off and wait
    until the outputs are at their safe values.

    Clients' references are refused meanwhile. Raises Refusal after a trip, if the loop executes no ticks in time and if
    a client sets another mode, and as `LiveReferences.play_raw` and `Desk.submit`. An error leaves the mode and the
    references as they are then: in mode raw, a loop that goes on plays the sine to its end, and holds 0 V.
    """
    rate_hz = live.prepared.plan.pacing.rate_hz
    sine_v = decaying_sine(options, rate_hz)
    with live.references.reserved("the actuator is being depolarised"):
        for axis in range(len(live.prepared.plan.axes)):
            live.references.play_raw(axis, sine_v)
        first_tick = desk.submit(Kind.SET_MODE, values=[float(Mode.RAW)])
        await_ticks(supervisor, sine_v.size, rate_hz, raw_from_tick=first_tick)
        desk.submit(Kind.SET_MODE, values=[float(Mode.OFF)])
        _await_rest(supervisor)


def decaying_sine(options: DepolariseOptions, rate_hz: float) -> npt.NDArray[np.float64]:
    """Return a sine (n,), V, a sample per tick, whose amplitude falls linearly from `amplitude_v` to 0."""
    sample_count = max(2, round(options.cycles / options.frequency_hz * rate_hz))
    phase = np.arange(sample_count) / (sample_count - 1)
    return options.amplitude_v * (1 - phase) * np.sin(2 * np.pi * options.cycles * phase)


def await_ticks(supervisor: Supervisor, count: int, rate_hz: float, raw_from_tick: int | None = None) -> None:
    """Wait until `count` more ticks were executed. Raises Refusal after a trip, and after 1 s plus TIMEOUT_FACTOR times
    the time that the ticks take at `rate_hz`.

    With `raw_from_tick`, raises Refusal also if a tick after `raw_from_tick` is not in mode raw, because another mode
    was requested.
    """
    final_tick, limit_s = supervisor.ticks + count, 1.0 + TIMEOUT_FACTOR * count / rate_hz
    start_s = timing.monotonic_s()
    while supervisor.ticks < final_tick:
        _require_progress(supervisor, start_s, limit_s)
        if raw_from_tick is not None and _has_left_raw(supervisor, raw_from_tick):
            raise Refusal("preparing the actuator: ended, because another mode was requested")
        timing.sleep(POLL_S)


def _has_left_raw(supervisor: Supervisor, from_tick: int) -> bool:
    """Return whether the newest tick is after `from_tick` and its mode is not raw."""
    row = supervisor.latest()
    return row is not None and bool(row[signals.TICK] > from_tick and row[signals.MODE] != Mode.RAW)


def _await_rest(supervisor: Supervisor) -> None:
    """Wait, after mode off was set, until no output ramps any more: all are then at their safe values.

    Raises Refusal after a trip, and after TIMEOUT_FACTOR + 1 seconds.
    """
    start_s, limit_s = timing.monotonic_s(), 1.0 + TIMEOUT_FACTOR
    while (row := supervisor.latest()) is None or int(row[signals.FLAGS]) & Flag.RAMPING:
        _require_progress(supervisor, start_s, limit_s)
        timing.sleep(POLL_S)


def _require_progress(supervisor: Supervisor, start_s: float, limit_s: float) -> None:
    """Raise Refusal after a trip, or once `limit_s` have passed since the monotonic time `start_s`."""
    row = supervisor.latest()
    if row is not None and (causes := signals.trip_causes(row[signals.FLAGS])):
        raise Refusal(f"preparing the actuator: the loop tripped ({', '.join(causes)})")
    if timing.monotonic_s() > start_s + limit_s:
        raise Refusal(
            f"preparing the actuator: not done after {limit_s:.3g} s, at tick {supervisor.ticks}: the loop stands "
            "still or runs too slowly; see `rtloop doctor`, or lower loop.rate_hz"
        )


def _mean_inputs_v(supervisor: Supervisor, count: int, axis_count: int) -> list[float]:
    """Wait for `count` ticks, at most half of the ring's length, and return the mean reading of each axis in them, V.

    The axes are in the order of their numbers. Raises as `await_ticks`.
    """
    count = min(count, len(supervisor.block["ticks_slots"]) // 2)
    await_ticks(supervisor, count, supervisor.prepared.plan.pacing.rate_hz)
    rows = supervisor.newest(count)
    return [float(np.mean(rows[:, signals.axis_column(axis, signals.ADC)])) for axis in range(axis_count)]

"""Before the first command: wipe out the actuator's memory with a dying sine, then take its rest as position 0."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt

from rtloop import signals
from rtloop.configuration.service import DepolariseOptions, ServiceOptions
from rtloop.engine.messages import Kind
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Desk, Refused
from rtloop.signals import Flag, Mode
from rtloop.supervision.supervisor import Supervisor

POLL_S = 0.01
PATIENCE = 3.0
"""A step of the preparation may take so many times as long as it should, and a second, before it is given up."""


def prepare_actuator(options: ServiceOptions, supervisor: Supervisor, live: LiveLaw, desk: Desk) -> None:
    """Depolarise and tare all axes, as the options say; outputs end at safe. Raises Refused where that fails."""
    axes = range(len(live.prepared.plan.axes))
    if options.depolarise is not None:
        sine_v = decaying_sine(options.depolarise, live.prepared.plan.pacing.rate_hz)
        for axis in axes:
            live.references.play_raw(axis, sine_v)
        desk.submit(Kind.SET_MODE, values=[float(Mode.RAW)])
        _await_ticks(supervisor, sine_v.size, live.prepared.plan.pacing.rate_hz)
        desk.submit(Kind.SET_MODE, values=[float(Mode.OFF)])
        _await_rest(supervisor)
    if options.tare_s > 0:
        count = max(1, round(options.tare_s * live.prepared.plan.pacing.rate_hz))
        for axis, offset_v in enumerate(_mean_inputs(supervisor, count, len(axes))):
            live.tare(axis, offset_v)


def decaying_sine(options: DepolariseOptions, rate_hz: float) -> npt.NDArray[np.float64]:
    """Samples in V of `cycles` cycles whose amplitude falls linearly to 0, shape (n,)."""
    sample_count = max(2, round(options.cycles / options.frequency_hz * rate_hz))
    phase = np.arange(sample_count) / (sample_count - 1)
    return options.amplitude_v * (1 - phase) * np.sin(2 * np.pi * options.cycles * phase)


def _await_ticks(supervisor: Supervisor, count: int, rate_hz: float) -> None:
    """Until `count` more ticks were executed. Raises Refused at a trip, or where they do not come."""
    final_tick, deadline_s = supervisor.ticks + count, time.monotonic() + 1.0 + PATIENCE * count / rate_hz
    while supervisor.ticks < final_tick:
        _check(supervisor, deadline_s)
        time.sleep(POLL_S)


def _await_rest(supervisor: Supervisor) -> None:
    """Until every output is at its safe value. Raises Refused at a trip."""
    deadline_s = time.monotonic() + 1.0 + PATIENCE
    while (row := supervisor.latest()) is None or int(row[signals.FLAGS]) & Flag.RAMPING:
        _check(supervisor, deadline_s)
        time.sleep(POLL_S)


def _check(supervisor: Supervisor, deadline_s: float) -> None:
    row = supervisor.latest()
    if row is not None and (causes := signals.trip_causes(row[signals.FLAGS])):
        raise Refused(f"preparing the actuator: tripped: {', '.join(causes)}")
    if time.monotonic() > deadline_s:
        raise Refused("preparing the actuator: the loop's ticks do not come")


def _mean_inputs(supervisor: Supervisor, count: int, axes: int) -> list[float]:
    """Mean raw input of each axis over the next `count` ticks, or as many as the ring holds."""
    count = min(count, len(supervisor.block["ticks_slots"]) // 2)
    _await_ticks(supervisor, count, supervisor.prepared.plan.pacing.rate_hz)
    rows = supervisor.newest(count)
    return [float(np.mean(rows[:, signals.axis_column(axis, signals.ADC)])) for axis in range(axes)]

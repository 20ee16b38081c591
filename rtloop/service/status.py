"""Status of a service, from the newest records."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from rtloop import signals
from rtloop.recording.columns import describe_signal
from rtloop.service.service import Service
from rtloop.signals import Flag, Mode
from rtloop.supervision.paths import block_path
from rtloop.supervision.recording_state import recording_state

WINDOW_TICKS = 10_000


def status(service: Service) -> dict[str, object]:
    """Return the content of `/status`: {name, state, armed, faults, lock: the lock's holder, measuring, recovery,
    ticks, realtime, recording, recorder_replacements, restarts: number of ended runs}, and the keys of `timing` and
    `newest_signals`, or in `no_signals` the reason why there are none.

    `measuring` is as `CurrentMeasurement.for_json`, `recovery` as `Recovery.for_json`. `recording` has the keys of
    `recording_state`, file and written_ticks. `measured`, the results by axis, is present once there is one. Without a
    loop, `ticks` and `recorder_replacements` are 0, and `realtime` and `recording` are {}.
    """
    supervisor = service.supervisor
    report: dict[str, object] = {
        "name": service.configuration.name,
        "state": service.state.value,
        "armed": service.armed,
        "faults": list(service.faults),
        "lock": service.lock.holder,
        "measuring": service.current_measurement.for_json(),
        "recovery": service.recovery.for_json(),
        "ticks": 0 if supervisor is None else supervisor.ticks,
        "realtime": {} if supervisor is None else supervisor.realtime,
        "recording": {}
        if supervisor is None
        else recording_state(supervisor.block) | supervisor.recorder.written_state,
        "recorder_replacements": 0 if supervisor is None else supervisor.recorder.replacements,
        "restarts": len(service.results),
    }
    if service.measurements:
        report["measured"] = {axis: results.for_json() for axis, results in service.measurements.items()}
    return report | timing(service) | (newest_signals(service) or {"no_signals": _reason_without_signals(service)})


def _reason_without_signals(service: Service) -> str:
    """Return, in words, why a status has no newest signals: the first loop, or the next one, has no tick yet."""
    if service.results:
        return "the last loop has ended, and the next loop has not executed a tick yet"
    return "the loop has not executed a tick yet"


def running_configuration(service: Service) -> dict[str, object]:
    """Return the running configuration with all changes, the columns of a record, and the paths of shared block and
    recordings: {folder, values, name, rate_hz, columns, block, recordings}.

    `folder` and `values` come from `LiveLaw.current_configuration`, each column is {name, unit, meaning}. Raises
    Refusal without a loop.
    """
    live = service.require_live()
    plan, configuration = live.prepared.plan, service.configuration
    return live.current_configuration | {
        "name": configuration.name,
        "rate_hz": plan.pacing.rate_hz,
        "columns": [describe_signal(name)._asdict() for name in plan.columns],
        "block": str(block_path(configuration.name).resolve()),
        "recordings": str(Path(configuration.recording.folder).resolve()),
    }


def timing(service: Service) -> dict[str, Any]:
    """Return {rate_hz, lateness_us: {p50, p99, max}, overruns, periods_missed} over the newest ticks, at most
    WINDOW_TICKS.

    `overruns` counts the ticks that ended after the next tick was due, `periods_missed` the periods without a tick.
    Returns {} without a loop and before the second tick.
    """
    rows = None if service.supervisor is None else service.supervisor.newest(WINDOW_TICKS)
    if rows is None or len(rows) < 2:
        return {}
    span_s = (rows[-1, signals.DEADLINE] - rows[0, signals.DEADLINE]) / 1e9
    lateness_us = rows[:, signals.LATENESS]
    flags = rows[:, signals.FLAGS].astype(np.int64)
    return {
        "rate_hz": (len(rows) - 1) / span_s,
        "lateness_us": {
            "p50": float(np.median(lateness_us)),
            "p99": float(np.quantile(lateness_us, 0.99)),
            "max": float(lateness_us.max()),
        },
        "overruns": int(np.count_nonzero(flags & Flag.OVERRUN)),
        "periods_missed": int(rows[:, signals.PERIODS_MISSED].sum()),
    }


def newest_signals(service: Service) -> dict[str, Any]:
    """Return {tick, mode, trip: causes, trip_reason, axes: {axis: {signal: value}}, condition: {axis: Condition}}: the
    newest tick, and the condition of each axis over the last half second.

    `trip` is [] and `trip_reason` None without a trip. A signal that is not finite is None; an axis outside closed loop
    has no condition. Returns {} without a loop and before its first tick.
    """
    supervisor = service.supervisor
    row = None if supervisor is None else supervisor.latest()
    if supervisor is None or row is None:
        return {}
    axes = {
        axis: {
            signal.name: _finite_or_none(row[signals.axis_column(number, column)])
            for column, signal in enumerate(signals.AXIS_SIGNALS)
        }
        for number, axis in enumerate(supervisor.prepared.plan.axes)
    }
    return {
        "tick": int(row[signals.TICK]),
        "mode": Mode(int(row[signals.MODE])).name.lower(),
        "trip": (causes := signals.trip_causes(row[signals.FLAGS])),
        "trip_reason": supervisor.trip_reason if causes else None,
        "axes": axes,
        "condition": {axis: sums.condition for axis, sums in service.quality.axes.items() if sums.condition},
    }


def _finite_or_none(value: float) -> float | None:
    """Return `value`, None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None

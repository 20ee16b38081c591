"""Figures of a rerun: differences by signal, and tracking performance by axis."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rtloop import signals
from rtloop.recording.replay.rerun import Rows
from rtloop.recording.views.steps import step_metrics
from rtloop.signals import AXIS_SIGNALS, TRIP_MASK, Mode, Trip

COMPARED_SIGNALS = (signals.POSITION, signals.ERROR, signals.COMMAND, signals.DEMAND, signals.DRIVE)
STEP_ANALYSIS_TICKS = 3_000_000
"""Number of ticks after which no more rows are cached for step metrics, which bounds memory."""


class SignalDifferences:
    """Largest and RMS difference of each computed signal; ticks with a non-finite difference are ignored."""

    def __init__(self, axes: Sequence[str]) -> None:
        """Begin without ticks; rows will have the columns of a recording with the named `axes`."""
        self._columns = [signals.axis_column(axis, signal) for axis in range(len(axes)) for signal in COMPARED_SIGNALS]
        self._names = [f"{axis}_{AXIS_SIGNALS[signal].name}" for axis in axes for signal in COMPARED_SIGNALS]
        size = len(self._columns)
        self._largest, self._at_tick = np.zeros(size), np.zeros(size, np.int64)
        self._square_sum, self._count = np.zeros(size), np.zeros(size, np.int64)
        self._trip: Trip | None = None

    def add(self, recorded: Rows, replayed: Rows) -> None:
        """Update largest difference, its tick and sum of squares of each signal, and the first trip of the replay.

        `recorded` and `replayed` are rows (n, columns) of the same ticks; non-finite differences are ignored.
        """
        if not len(recorded):
            return
        with np.errstate(invalid="ignore"):
            difference = np.abs(replayed[:, self._columns] - recorded[:, self._columns])
        finite = np.isfinite(difference)
        difference[~finite] = 0.0
        rows, places = difference.argmax(axis=0), np.arange(len(self._columns))
        is_larger = difference[rows, places] > self._largest
        self._largest[is_larger] = difference[rows, places][is_larger]
        self._at_tick[is_larger] = recorded[rows[is_larger], signals.TICK].astype(np.int64)
        self._square_sum += np.einsum("ij,ij->j", difference, difference)
        self._count += finite.sum(axis=0)
        self._trip = self._trip or first_trip(replayed)

    def report(self) -> dict[str, object]:
        """Return {signals: {name: {max, at_tick, rms}}, trip: {tick, causes} of the replay or None}.

        `max` and `rms` are of the absolute difference, in the signal's unit; a signal without a finite difference has
        zeros.
        """
        rms = np.sqrt(self._square_sum / np.maximum(self._count, 1))
        rows = zip(self._names, self._largest.tolist(), self._at_tick.tolist(), rms.tolist(), strict=True)
        return {
            "signals": {name: {"max": largest, "at_tick": tick, "rms": mean} for name, largest, tick, mean in rows},
            "trip": self._trip,
        }


class TrackingPerformance:
    """Tracking error over closed-loop ticks, largest drive and steps of every axis."""

    def __init__(self, axes: Sequence[str], rate_hz: float) -> None:
        """Begin without ticks; rows will have the columns of a recording with the named `axes`, at `rate_hz`."""
        self._axes, self._rate_hz = range(len(axes)), rate_hz
        self._square_sum, self._count = np.zeros(len(axes)), 0
        self._drive_v, self._error_um = np.zeros(len(axes)), np.zeros(len(axes))
        self._traces: list[Rows] = []
        self._trace_ticks = 0
        self.trip: Trip | None = None

    def add(self, rows: Rows) -> None:
        """Add rows (n, columns) of consecutive ticks; a NaN error in closed loop counts as 0.

        The first trip is stored in `trip` as {tick, causes}. Rows after STEP_ANALYSIS_TICKS do not count for the steps.
        """
        if not len(rows):
            return
        errors, drives = (rows[:, [signals.axis_column(axis, signal) for axis in self._axes]]
                          for signal in (signals.ERROR, signals.DRIVE))  # fmt: skip
        errors = np.nan_to_num(errors[rows[:, signals.MODE] == Mode.CLOSED_LOOP])
        self._square_sum += np.einsum("ij,ij->j", errors, errors)
        self._count += len(errors)
        if len(errors):
            self._error_um = np.maximum(self._error_um, np.abs(errors).max(axis=0))
        self._drive_v = np.fmax(self._drive_v, np.abs(drives).max(axis=0))
        if self._trace_ticks < STEP_ANALYSIS_TICKS:
            columns = [
                signals.axis_column(a, signal) for a in self._axes for signal in (signals.REFERENCE, signals.POSITION)
            ]
            self._traces.append(rows[:, columns].copy())
            self._trace_ticks += len(rows)
        self.trip = self.trip or first_trip(rows)

    def report(self) -> list[dict[str, object]]:
        """Return a dict for each axis, in their order: rms_error_um, max_abs_error_um, max_abs_drive_v and steps.

        The errors are None if the loop was never closed. `steps` is `StepMetrics.as_dict`, or None where `step_metrics`
        has none.
        """
        traces = np.concatenate(self._traces) if self._traces else np.empty((0, 2 * len(self._axes)))
        return [
            {
                "rms_error_um": math.sqrt(self._square_sum[axis] / self._count) if self._count else None,
                "max_abs_error_um": float(self._error_um[axis]) if self._count else None,
                "max_abs_drive_v": float(self._drive_v[axis]),
                "steps": metrics and metrics.as_dict(),
            }
            for axis in self._axes
            for metrics in [step_metrics(traces[:, 2 * axis], traces[:, 2 * axis + 1], self._rate_hz)]
        ]


def first_trip(rows: Rows) -> Trip | None:
    """Return {tick, causes} of the first tripped row of `rows` (n, columns); None if no row is tripped."""
    tripped = np.flatnonzero(rows[:, signals.FLAGS].astype(np.int64) & TRIP_MASK)
    if not tripped.size:
        return None
    row = rows[tripped[0]]
    return {"tick": int(row[signals.TICK]), "causes": signals.trip_causes(row[signals.FLAGS])}

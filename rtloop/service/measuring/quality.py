"""How well the loop does, summed up over weeks: sums that only grow, of which a monitoring system takes rates.

Everything is read off the ring of ticks, by one more reader, twice a second: rms error over any interval is
√(Δ Σe² / Δ n), with n the closed-loop ticks. What a loop did in the half second before its process ended is not in it,
and ticks that were overwritten before they could be read are counted as unseen.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from rtloop import signals
from rtloop.recording.capture.rings import RingReader
from rtloop.service.measuring.condition import Condition, condition
from rtloop.signals import Flag, Mode
from rtloop.supervision.supervisor import Supervisor

if TYPE_CHECKING:
    from rtloop.configuration.axis import LimitsOptions

LOOK_S = 0.5
MOST_TICKS = 1 << 14
PEAK_LOOKS = 120
"""How far back the largest values go: a minute of looks."""
LATENESS_US = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1e3, 2e3, 5e3, 1e4, 1e5)
"""Upper ends of the classes of the lateness."""
LIMITED = {"command": Flag.COMMAND_LIMITED, "drive": Flag.DRIVE_LIMITED, "slew": Flag.SLEW_LIMITED}
Rows = np.ndarray[Any, Any]


@dataclass
class AxisSums:
    """Of one axis; the error is that of closed-loop ticks, the drive that of all. What is not finite is left out."""

    closed_ticks: int = 0
    error_um2: float = 0.0
    drive_v2: float = 0.0
    peaks: deque[tuple[float, float, float]] = field(default_factory=lambda: deque(maxlen=PEAK_LOOKS))
    """Of each of the last looks: largest |error| in µm, least and largest drive in V."""
    condition: Condition | None = None
    """At the newest look."""

    def add(self, error_um: Rows, drive_v: Rows, closed: Rows) -> None:
        """Some ticks, at least one."""
        errors = error_um[closed & np.isfinite(error_um)]
        drives = drive_v[np.isfinite(drive_v)]
        self.closed_ticks += len(errors)
        self.error_um2 += float(errors @ errors)
        self.drive_v2 += float(drives @ drives)
        if len(drives):
            self.peaks.append((float(np.abs(errors).max(initial=0.0)), float(drives.min()), float(drives.max())))


class Quality:
    """Sums over all ticks of all loops of a service."""

    def __init__(self) -> None:
        self.ticks = self.unseen = self.overruns = self.periods_missed = 0
        self.limited = dict.fromkeys(LIMITED, 0)
        self.trips: dict[str, int] = dict.fromkeys(signals.trip_causes(signals.TRIP_MASK), 0)
        self.lateness = np.zeros(len(LATENESS_US) + 1, np.int64)
        self.lateness_sum_us = 0.0
        self.axes: dict[str, AxisSums] = {}
        self.lock = threading.Lock()
        """Held while the sums change."""
        self._supervisor: Supervisor | None = None
        self._reader: RingReader | None = None
        self._rows: Rows = np.empty((0, 0))
        self._flags = 0

    def look(self, supervisor: Supervisor | None, limits: Sequence[LimitsOptions] = ()) -> None:
        """Count what ticked since the last time, and judge each axis by its `limits`."""
        if supervisor is None or not supervisor.ticks:
            for sums in self.axes.values():
                sums.condition = None
            return
        if supervisor is not self._supervisor:
            self._supervisor, self._flags = supervisor, 0
            self._reader = RingReader(supervisor.block, "ticks")
            self._rows = np.empty((MOST_TICKS, len(supervisor.prepared.plan.columns)))
        reader, row_count = self._reader, MOST_TICKS
        while reader is not None and row_count == MOST_TICKS:  # what comes in meanwhile can wait for the next look
            row_count, lost_count = reader.take_into(self._rows)
            with self.lock:
                self.unseen += lost_count
                if row_count:
                    self._add(self._rows[:row_count], supervisor.prepared.plan.axes)
                    for number, (axis, axis_limits) in enumerate(
                        zip(supervisor.prepared.plan.axes, limits, strict=False)
                    ):
                        self.axes[axis].condition = condition(self._rows[:row_count], number, axis_limits)

    def _add(self, rows: Rows, axes: tuple[str, ...]) -> None:
        flags = rows[:, signals.FLAGS].astype(np.int64)
        self.ticks += len(rows)
        self.overruns += int(np.count_nonzero(flags & Flag.OVERRUN))
        self.periods_missed += int(rows[:, signals.PERIODS_MISSED].sum())
        for name, flag in LIMITED.items():
            self.limited[name] += int(np.count_nonzero(flags & flag))
        lateness_us = rows[:, signals.LATENESS]
        lateness_us = lateness_us[np.isfinite(lateness_us)]  # in virtual time nothing is measured
        self.lateness += np.bincount(np.searchsorted(LATENESS_US, lateness_us), minlength=len(self.lateness))
        self.lateness_sum_us += float(lateness_us.sum())
        self._count_trips(flags & signals.TRIP_MASK)
        is_closed_loop = rows[:, signals.MODE] == Mode.CLOSED_LOOP
        for number, axis in enumerate(axes):
            error, drive = (rows[:, signals.axis_column(number, signal)] for signal in (signals.ERROR, signals.DRIVE))
            self.axes.setdefault(axis, AxisSums()).add(error, drive, is_closed_loop)

    def _count_trips(self, latched: Rows) -> None:
        """Causes that are latched, and were not a tick before."""
        previous = np.concatenate([[self._flags], latched[:-1]])
        self._flags = int(latched[-1])
        for new_causes in (latched & ~previous)[latched != previous].tolist():
            for cause in signals.trip_causes(new_causes):
                self.trips[cause] += 1


@contextlib.contextmanager
def summed(
    quality: Quality, present: Callable[[], tuple[Supervisor | None, Sequence[LimitsOptions]]]
) -> Iterator[None]:
    """Sum up what the `present` loop does within its limits, one after the other, in a thread of its own."""
    end_event = threading.Event()

    def watch() -> None:
        while not end_event.wait(LOOK_S):
            quality.look(*present())

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        end_event.set()

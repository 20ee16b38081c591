"""Quality of control over weeks: sums that only grow, from which a monitoring system computes rates.

An additional reader reads the ring of ticks twice a second. The rms error over any interval is √(Δ Σe² / Δ n), with n
the closed-loop ticks. The last half second before the end of a loop's process is missing; ticks that were overwritten
before they were read are counted as unread.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rtloop import signals
from rtloop.foundation import timing
from rtloop.foundation.arrays import Real
from rtloop.recording.capture.rings import RingReader
from rtloop.service.background import repeat_every
from rtloop.service.measuring.condition import Condition, axis_condition
from rtloop.signals import Flag, Mode
from rtloop.supervision.supervisor import Supervisor

if TYPE_CHECKING:
    from rtloop.configuration.axis import LimitsOptions

LOOK_PERIOD_S = 0.5
MAX_TICKS = 1 << 14
PEAK_LOOKS = 120
"""Number of updates, one minute, whose largest values are stored."""
LATENESS_US = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1e3, 2e3, 5e3, 1e4, 1e5)
"""Upper bounds of the buckets of the lateness."""
LIMIT_FLAGS = {"command": Flag.COMMAND_LIMITED, "drive": Flag.DRIVE_LIMITED, "slew": Flag.SLEW_LIMITED}


@dataclass
class AxisSums:
    """Sums of one axis: squared error (µm²) over closed-loop ticks, squared drive (V²) over all ticks.

    Values that are not finite are skipped.
    """

    closed_ticks: int = 0
    error_um2: float = 0.0
    drive_v2: float = 0.0
    peaks: deque[tuple[float, float, float]] = field(default_factory=lambda: deque(maxlen=PEAK_LOOKS))
    """Largest |error| (µm), smallest and largest drive (V) of each of the last updates."""
    condition: Condition | None = None
    """Condition at the newest update; None outside closed loop."""

    def add(self, error_um: Real, drive_v: Real, is_closed_loop: npt.NDArray[np.bool_]) -> None:
        """Add n ticks to the sums, the error (µm) of the ticks in closed loop and the drive (V) of all, and their
        largest values to `peaks`.

        All arrays are (n,); `is_closed_loop` marks the ticks in closed loop. Values that are not finite are skipped;
        without a finite drive `peaks` stays.
        """
        errors = error_um[is_closed_loop & np.isfinite(error_um)]
        drives = drive_v[np.isfinite(drive_v)]
        self.closed_ticks += len(errors)
        self.error_um2 += float(errors @ errors)
        self.drive_v2 += float(drives @ drives)
        if len(drives):
            self.peaks.append((float(np.abs(errors).max(initial=0.0)), float(drives.min()), float(drives.max())))


class Quality:
    """Sums over all ticks of all loops of a service.

    `limited_ticks` counts ticks by limit, `trips` trips by cause, `lateness` (buckets,) the ticks of each bucket, the
    last of them beyond LATENESS_US. `axes` has the sums of each axis by name.
    """

    def __init__(self) -> None:
        """Begin with sums of 0, without axes; `update` adds ticks."""
        self.ticks = self.unread_ticks = self.overruns = self.periods_missed = 0
        self.limited_ticks = dict.fromkeys(LIMIT_FLAGS, 0)
        self.trips: dict[str, int] = dict.fromkeys(signals.trip_causes(signals.TRIP_MASK), 0)
        self.lateness = np.zeros(len(LATENESS_US) + 1, np.int64)
        self.lateness_sum_us = 0.0
        self.axes: dict[str, AxisSums] = {}
        self.lock = timing.lock()
        """Held while the sums change, and while they are read together."""
        self._supervisor: Supervisor | None = None
        self._reader: RingReader | None = None
        self._rows: Real = np.empty((0, 0))
        self._last_trip_flags = 0

    def update(self, supervisor: Supervisor | None, limits: Sequence[LimitsOptions] = ()) -> None:
        """Add the ticks since the last call, and set the condition of each axis, by its `limits`, over the newest of
        them, at most MAX_TICKS; without new ticks the conditions stay.

        `limits` are in the order of axes. Another `supervisor` is another loop, whose ticks are added from its first
        one. None, without a loop, clears the conditions, and so does a loop before its first tick.
        """
        if supervisor is None or not supervisor.ticks:
            for sums in self.axes.values():
                sums.condition = None
            return
        if supervisor is not self._supervisor:
            self._supervisor, self._last_trip_flags = supervisor, 0
            self._reader = RingReader(supervisor.block, "ticks")
            self._rows = np.empty((MAX_TICKS, len(supervisor.prepared.plan.columns)))
        reader, row_count = self._reader, MAX_TICKS
        while reader is not None and row_count == MAX_TICKS:  # Later ticks are read in the next update.
            row_count, lost_count = reader.take_into(self._rows)
            with self.lock:
                self.unread_ticks += lost_count
                if row_count:
                    self._add(self._rows[:row_count], supervisor.prepared.plan.axes)
                    for number, (axis, axis_limits) in enumerate(
                        zip(supervisor.prepared.plan.axes, limits, strict=False)
                    ):
                        self.axes[axis].condition = axis_condition(self._rows[:row_count], number, axis_limits)

    def _add(self, rows: Real, axes: tuple[str, ...]) -> None:
        """Add the records `rows` (n, columns) of a loop with these axes, n > 0, to all sums."""
        flags = rows[:, signals.FLAGS].astype(np.int64)
        self.ticks += len(rows)
        self.overruns += int(np.count_nonzero(flags & Flag.OVERRUN))
        self.periods_missed += int(rows[:, signals.PERIODS_MISSED].sum())
        for name, flag in LIMIT_FLAGS.items():
            self.limited_ticks[name] += int(np.count_nonzero(flags & flag))
        lateness_us = rows[:, signals.LATENESS]
        lateness_us = lateness_us[np.isfinite(lateness_us)]  # Virtual time has no lateness.
        self.lateness += np.bincount(np.searchsorted(LATENESS_US, lateness_us), minlength=len(self.lateness))
        self.lateness_sum_us += float(lateness_us.sum())
        self._count_trips(flags & signals.TRIP_MASK)
        is_closed_loop = rows[:, signals.MODE] == Mode.CLOSED_LOOP
        for number, axis in enumerate(axes):
            error, drive = (rows[:, signals.axis_column(number, signal)] for signal in (signals.ERROR, signals.DRIVE))
            self.axes.setdefault(axis, AxisSums()).add(error, drive, is_closed_loop)

    def _count_trips(self, latched: npt.NDArray[np.int64]) -> None:
        """Count each trip cause that was not latched one tick before, in the trip flags `latched` (n,) of successive
        ticks.
        """
        previous = np.concatenate([[self._last_trip_flags], latched[:-1]])
        self._last_trip_flags = int(latched[-1])
        for new_causes in (latched & ~previous)[latched != previous].tolist():
            for cause in signals.trip_causes(new_causes):
                self.trips[cause] += 1


def watch_quality(
    quality: Quality, current_loop: Callable[[], tuple[Supervisor | None, Sequence[LimitsOptions]]]
) -> AbstractContextManager[None]:
    """Return a context manager: during the work within, a thread calls `quality.update` every LOOK_PERIOD_S.

    `current_loop` returns the running supervisor, None without one, and the limits of its axes.
    """
    return repeat_every(LOOK_PERIOD_S, lambda: quality.update(*current_loop()))

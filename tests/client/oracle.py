"""Reference trigger in plain Python that examines one tick after the other: the sweeps that triggers must find."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

Record = dict[str, float]
TRIP_BITS = 0xFFFFFF00


class ConditionSpec(NamedTuple):
    """Trigger condition: kind (edge, window, trip, mode, late or step) and figures, of which each kind uses some."""

    kind: str
    level: float = 0.0
    slope: str = "rising"
    hysteresis: float = 0.0
    low: float = 0.0
    high: float = 0.0
    threshold: float = 0.0


class ConditionMonitor:
    """Examines consecutive records for one condition, with a method for each kind."""

    def __init__(self, spec: ConditionSpec) -> None:
        self.spec, self.previous = spec, None
        self.low_seen = self.high_seen = self.inside_seen = False

    def is_met(self, record: Record, after_gap: bool) -> bool:
        """Return whether the next record meets the condition; `after_gap` tells that ticks were lost before it."""
        previous, self.previous = self.previous, record
        return getattr(self, f"_{self.spec.kind}")(record["s"], record, previous, after_gap)

    def _edge(self, s: float, _record: Record, _previous: Record | None, after_gap: bool) -> bool:
        """Return whether s reaches the level after it was beyond the hysteresis on the other side."""
        spec = self.spec
        up, down = s >= spec.level, s <= spec.level
        if after_gap:
            self.low_seen, self.high_seen = self.low_seen and up, self.high_seen and down
        rising, falling = self.low_seen and up, self.high_seen and down
        if up:
            self.low_seen = False
        if down:
            self.high_seen = False
        if s < spec.level - spec.hysteresis:
            self.low_seen = True
        if s > spec.level + spec.hysteresis:
            self.high_seen = True
        return (rising and spec.slope != "falling") or (falling and spec.slope != "rising")

    def _window(self, s: float, _record: Record, _previous: Record | None, after_gap: bool) -> bool:
        """Return whether s leaves the window after it was inside."""
        inside, outside = self.spec.low <= s <= self.spec.high, s < self.spec.low or s > self.spec.high
        if after_gap and not outside:
            self.inside_seen = False
        has_left = outside and self.inside_seen
        if inside or outside:
            self.inside_seen = inside
        return has_left

    def _trip(self, _s: float, record: Record, previous: Record | None, _after_gap: bool) -> bool:
        """Return whether a trip flag is set that was not set at the previous record."""
        previous_trips = int(record["flags"] if previous is None else previous["flags"]) & TRIP_BITS
        return any(int(record["flags"]) >> bit & 1 and not previous_trips >> bit & 1 for bit in range(8, 32))

    def _mode(self, _s: float, record: Record, previous: Record | None, _after_gap: bool) -> bool:
        """Return whether the mode differs from the mode of the previous record."""
        return previous is not None and previous["mode"] != record["mode"]

    def _late(self, _s: float, record: Record, _previous: Record | None, _after_gap: bool) -> bool:
        """Return whether periods were missed."""
        return record["periods_missed"] > 0

    def _step(self, s: float, _record: Record, previous: Record | None, after_gap: bool) -> bool:
        """Return whether s changes by more than the threshold from one tick to the next."""
        if previous is None or after_gap or math.isnan(s) or math.isnan(previous["s"]):
            return False
        return abs(s - previous["s"]) > self.spec.threshold


def expected_sweeps(
    spec: ConditionSpec, settings: Any, records: dict[int, Record], force_at: int | None = None
) -> list[tuple]:
    """Return (first, trigger, end, cause, uncertain ticks) of each sweep that ends with the records or before.

    `records` has the record of each tick that is not lost; a sweep is forced from tick `force_at` on.
    """
    ticks, monitor = sorted(records), ConditionMonitor(spec)
    pre_ticks = round((settings.ticks - 1) * settings.pre_percent / 100)
    sweeps: list[tuple] = []
    free_tick = ready_tick = ticks[0]
    has_swept, forced = False, False
    for index, tick in enumerate(ticks):
        lost_ticks = tick - ticks[index - 1] - 1 if index else 0
        forced = forced or tick == force_at
        is_met = monitor.is_met(records[tick], lost_ticks > 0)
        cause = None
        if is_met and tick >= ready_tick and not (settings.mode == "single" and has_swept):
            cause = "trigger"
        elif forced and tick >= free_tick:
            cause = "forced"
        elif settings.mode == "auto" and tick >= ready_tick + settings.auto_ticks:
            cause = "auto"
        if cause is not None:
            end = tick - pre_ticks + settings.ticks
            uncertain_ticks = lost_ticks if cause == "trigger" and spec.kind != "late" else 0
            sweeps.append((tick - pre_ticks, tick, end, cause, uncertain_ticks))
            has_swept = has_swept or cause != "auto"
            free_tick, ready_tick, forced = end, max(end, tick + settings.holdoff_ticks), False
    return [sweep for sweep in sweeps if sweep[2] <= ticks[-1] + 1]

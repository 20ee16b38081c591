"""Reference scope in plain Python that looks at one tick after the other: the sweeps that triggers must find."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

Record = dict[str, float]
TRIP_BITS = 0xFFFFFF00


class Wanted(NamedTuple):
    """What is looked for: `kind` edge, window, trip, mode, late or step, and its figures."""

    kind: str
    level: float = 0.0
    slope: str = "rising"
    hysteresis: float = 0.0
    low: float = 0.0
    high: float = 0.0
    threshold: float = 0.0


class Eye:
    """Looks at one tick after the other; `see` says whether the condition is met there."""

    def __init__(self, wanted: Wanted) -> None:
        self.wanted, self.before = wanted, None
        self.low_seen = self.high_seen = self.inside_seen = False

    def see(self, record: Record, after_gap: bool) -> bool:
        before, self.before = self.before, record
        return getattr(self, f"_{self.wanted.kind}")(record["s"], record, before, after_gap)

    def _edge(self, s: float, _r: Record, _b: Record | None, after_gap: bool) -> bool:
        w = self.wanted
        up, down = s >= w.level, s <= w.level
        if after_gap:
            self.low_seen, self.high_seen = self.low_seen and up, self.high_seen and down
        rising, falling = self.low_seen and up, self.high_seen and down
        if up:
            self.low_seen = False
        if down:
            self.high_seen = False
        if s < w.level - w.hysteresis:
            self.low_seen = True
        if s > w.level + w.hysteresis:
            self.high_seen = True
        return (rising and w.slope != "falling") or (falling and w.slope != "rising")

    def _window(self, s: float, _r: Record, _b: Record | None, after_gap: bool) -> bool:
        inside, outside = self.wanted.low <= s <= self.wanted.high, s < self.wanted.low or s > self.wanted.high
        if after_gap and not outside:
            self.inside_seen = False
        left = outside and self.inside_seen
        if inside or outside:
            self.inside_seen = inside
        return left

    def _trip(self, _s: float, record: Record, before: Record | None, _gap: bool) -> bool:
        had = int(record["flags"] if before is None else before["flags"]) & TRIP_BITS
        return any(int(record["flags"]) >> bit & 1 and not had >> bit & 1 for bit in range(8, 32))

    def _mode(self, _s: float, record: Record, before: Record | None, _gap: bool) -> bool:
        return before is not None and before["mode"] != record["mode"]

    def _late(self, _s: float, record: Record, _b: Record | None, _gap: bool) -> bool:
        return record["periods_missed"] > 0

    def _step(self, s: float, _r: Record, before: Record | None, after_gap: bool) -> bool:
        if before is None or after_gap or math.isnan(s) or math.isnan(before["s"]):
            return False
        return abs(s - before["s"]) > self.wanted.threshold


def sweeps(wanted: Wanted, settings: Any, records: dict[int, Record], force_at: int | None = None) -> list[tuple]:
    """(first, trigger, end, cause, uncertain) of the sweeps that end; `records` by tick, without lost ones."""
    ticks, eye = sorted(records), Eye(wanted)
    pre = round((settings.ticks - 1) * settings.pre_percent / 100)
    found: list[tuple] = []
    free = ready = ticks[0]
    taken, forced = False, False
    for place, tick in enumerate(ticks):
        lost = tick - ticks[place - 1] - 1 if place else 0
        forced = forced or tick == force_at
        met = eye.see(records[tick], lost > 0)
        cause = None
        if met and tick >= ready and not (settings.mode == "single" and taken):
            cause = "trigger"
        elif forced and tick >= free:
            cause = "forced"
        elif settings.mode == "auto" and tick >= ready + settings.auto_ticks:
            cause = "auto"
        if cause is not None:
            end = tick - pre + settings.ticks
            found.append((tick - pre, tick, end, cause, lost if cause == "trigger" and wanted.kind != "late" else 0))
            taken = taken or cause != "auto"
            free, ready, forced = end, max(end, tick + settings.holdoff_ticks), False
    return [sweep for sweep in found if sweep[2] <= ticks[-1] + 1]

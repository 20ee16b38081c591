"""When a sweep is taken: a scope's trigger at the loop's full rate, at the exact tick, in whatever lengths ticks come.

One sweep is open at a time. The next one begins with the first place where the condition is met after the sweep has
ended and the hold-off, counted from its trigger, is over.

    auto     as normal, and without a trigger once none has come for `auto_ticks`
    normal   at triggers alone
    single   one sweep, until `arm` is called
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import NamedTuple

from rtloop.panel.conditions import Condition
from rtloop.panel.stretch import Stretch


class Mode(StrEnum):
    """When sweeps are taken."""

    AUTO = "auto"
    NORMAL = "normal"
    SINGLE = "single"


class Cause(StrEnum):
    """What a sweep was begun by; of several at one tick, the first one here."""

    TRIGGER = "trigger"
    FORCED = "forced"
    AUTO = "auto"


class Sweep(NamedTuple):
    """Ticks `first` … `end` − 1 of a run about tick `trigger`, which is one of them.

    `first` may lie before what was read, even before tick 0; `end` is earlier than asked for where the run ended.
    """

    run: int
    first: int
    trigger: int
    end: int
    cause: Cause
    uncertain_ticks: int = 0
    """Ticks in front of `trigger` that were lost, in one of which it may have been."""


@dataclass(frozen=True)
class Settings:
    """Of a trigger. Sweeps are `ticks` long, and `pre_percent` of that lies before the trigger: 0 puts it at the first
    tick, 100 at the last one. Raises ValueError.
    """

    ticks: int
    mode: Mode = Mode.AUTO
    pre_percent: float = 50.0
    holdoff_ticks: int = 0
    auto_ticks: int = 1000

    def __post_init__(self) -> None:
        for name, minimum in (("ticks", 1), ("holdoff_ticks", 0), ("auto_ticks", 1)):
            if (value := getattr(self, name)) < minimum:
                raise ValueError(f"trigger {name}: {value}; at least {minimum} is needed")
        if not 0 <= self.pre_percent <= 100:
            raise ValueError(f"trigger pre_percent: {self.pre_percent:g}; 0 … 100 is allowed")

    @cached_property
    def pre_ticks(self) -> int:
        """Of a sweep, before its trigger."""
        return round((self.ticks - 1) * self.pre_percent / 100)


class Trigger:
    """Finds sweeps in stretches, which are fed in order; `condition` makes what is looked for, anew for each run."""

    def __init__(self, settings: Settings, make_condition: Callable[[], Condition]) -> None:
        self._settings, self._make_condition = settings, make_condition
        self._condition = make_condition()
        self._is_armed, self._is_forced = True, False
        self._run, self._next_tick = -1, 0
        self._free_tick = self._ready_tick = 0
        self.open_sweep: Sweep | None = None
        """The sweep that has begun and not ended."""

    def arm(self) -> None:
        """Allow a single sweep more."""
        self._is_armed = True

    def force(self) -> None:
        """Begin a sweep with the next tick, or as soon as the open one has ended, in any mode."""
        self._is_forced = True

    def close(self) -> Sweep | None:
        """End the open sweep with the last tick that was fed, where no more will come."""
        sweep, self.open_sweep = self.open_sweep, None
        return None if sweep is None else sweep._replace(end=self._next_tick)

    def feed(self, stretch: Stretch) -> list[Sweep]:
        """The sweeps that end in it. Raises ValueError where the run has no such signal.

        Another run begins from nothing: what was open is dropped, unless it was closed before.
        """
        values = stretch[self._condition.source]
        if len(stretch) == 0:
            return []
        if stretch.run != self._run:
            self._condition, self.open_sweep = self._make_condition(), None
            self._run, self._next_tick = stretch.run, stretch.first
            self._free_tick = self._ready_tick = stretch.first
        lost_ticks = stretch.first - self._next_tick
        indices = self._condition.find(values, lost_ticks > 0).tolist()
        self._next_tick = stretch.end
        sweeps = []
        while self.open_sweep is not None or self._open_sweep(stretch, indices, lost_ticks):
            if self.open_sweep is None or self.open_sweep.end > stretch.end:
                break
            sweeps.append(self.open_sweep)
            self.open_sweep = None
        return sweeps

    def _open_sweep(self, stretch: Stretch, indices: list[int], lost_ticks: int) -> bool:
        """Open the next sweep that begins in the stretch; False where none does."""
        settings, tick, cause = self._settings, stretch.end, None
        if settings.mode is not Mode.SINGLE or self._is_armed:
            next_index = bisect_left(indices, self._ready_tick - stretch.first)
            if next_index < len(indices):
                tick, cause = stretch.first + indices[next_index], Cause.TRIGGER
        if self._is_forced and (free_tick := max(self._free_tick, stretch.first)) < tick:
            tick, cause = free_tick, Cause.FORCED
        if (
            settings.mode is Mode.AUTO
            and (auto_tick := max(self._ready_tick + settings.auto_ticks, stretch.first)) < tick
        ):
            tick, cause = auto_tick, Cause.AUTO
        if cause is None:
            return False
        is_exact = cause is not Cause.TRIGGER or self._condition.is_exact(tick - stretch.first, lost_ticks > 0)
        first = tick - settings.pre_ticks
        self.open_sweep = Sweep(stretch.run, first, tick, first + settings.ticks, cause, 0 if is_exact else lost_ticks)
        self._free_tick = self.open_sweep.end
        self._ready_tick = max(self._free_tick, tick + settings.holdoff_ticks)
        self._is_armed = self._is_forced = False
        return True

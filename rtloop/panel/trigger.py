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

    def __init__(self, settings: Settings, condition: Callable[[], Condition]) -> None:
        self._settings, self._make = settings, condition
        self._condition = condition()
        self._armed, self._forced = True, False
        self._run, self._next = -1, 0
        self._free = self._ready = 0
        self.open: Sweep | None = None
        """The sweep that has begun and not ended."""

    def arm(self) -> None:
        """Allow a single sweep more."""
        self._armed = True

    def force(self) -> None:
        """Begin a sweep with the next tick, or as soon as the open one has ended, in any mode."""
        self._forced = True

    def close(self) -> Sweep | None:
        """End the open sweep with the last tick that was fed, where no more will come."""
        sweep, self.open = self.open, None
        return None if sweep is None else sweep._replace(end=self._next)

    def feed(self, stretch: Stretch) -> list[Sweep]:
        """The sweeps that end in it. Raises ValueError where the run has no such signal.

        Another run begins from nothing: what was open is dropped, unless it was closed before.
        """
        values = stretch[self._condition.source]
        if len(stretch) == 0:
            return []
        if stretch.run != self._run:
            self._condition, self.open = self._make(), None
            self._run, self._next = stretch.run, stretch.first
            self._free = self._ready = stretch.first
        lost_ticks = stretch.first - self._next
        indices = self._condition.find(values, lost_ticks > 0).tolist()
        self._next = stretch.end
        sweeps = []
        while self.open is not None or self._begin(stretch, indices, lost_ticks):
            if self.open is None or self.open.end > stretch.end:
                break
            sweeps.append(self.open)
            self.open = None
        return sweeps

    def _begin(self, stretch: Stretch, places: list[int], lost: int) -> bool:
        """Open the next sweep that begins in the stretch; False where none does."""
        settings, tick, cause = self._settings, stretch.end, None
        if settings.mode is not Mode.SINGLE or self._armed:
            next_index = bisect_left(places, self._ready - stretch.first)
            if next_index < len(places):
                tick, cause = stretch.first + places[next_index], Cause.TRIGGER
        if self._forced and (free_tick := max(self._free, stretch.first)) < tick:
            tick, cause = free_tick, Cause.FORCED
        if settings.mode is Mode.AUTO and (auto_tick := max(self._ready + settings.auto_ticks, stretch.first)) < tick:
            tick, cause = auto_tick, Cause.AUTO
        if cause is None:
            return False
        is_exact = cause is not Cause.TRIGGER or self._condition.at_its_tick(tick - stretch.first, lost > 0)
        first = tick - settings.pre_ticks
        self.open = Sweep(stretch.run, first, tick, first + settings.ticks, cause, 0 if is_exact else lost)
        self._free = self.open.end
        self._ready = max(self._free, tick + settings.holdoff_ticks)
        self._armed = self._forced = False
        return True

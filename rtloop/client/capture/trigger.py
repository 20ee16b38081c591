"""A scope's trigger: it finds sweeps at the exact tick, at the loop's full rate, in batches of any length.

One sweep is open at a time. The next sweep begins at the first tick that meets the condition after the end of that
sweep and after the hold-off, counted from its trigger.

    auto     as normal, and also when no trigger came for `auto_ticks`
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

from rtloop.client.capture.conditions import Condition
from rtloop.client.ticks.tick_stretch import Stretch


class Mode(StrEnum):
    """Trigger mode: which sweeps are recorded."""

    AUTO = "auto"
    NORMAL = "normal"
    SINGLE = "single"


class Cause(StrEnum):
    """Cause of a sweep; if several coincide, the first of this list."""

    TRIGGER = "trigger"
    FORCED = "forced"
    AUTO = "auto"


class Sweep(NamedTuple):
    """Ticks `first` … `end` − 1 of a run, with the tick `trigger` among them.

    `first` may be a tick that was not read, even a negative one; the sweep is shorter if the run ended within it.
    """

    run: int
    first: int
    trigger: int
    end: int
    cause: Cause
    uncertain_ticks: int = 0
    """Lost ticks directly before `trigger`; the condition may have been met in one of them."""


@dataclass(frozen=True)
class Settings:
    """Settings of a trigger: sweeps of `ticks` ticks, `pre_percent` of them before the trigger (0 puts the trigger at
    the first tick, 100 at the last). No sweep is triggered within `holdoff_ticks` after a sweep's trigger; in mode auto
    one begins after `auto_ticks` without a trigger. Raises ValueError for a value outside its range.
    """

    ticks: int
    mode: Mode = Mode.AUTO
    pre_percent: float = 50.0
    holdoff_ticks: int = 0
    auto_ticks: int = 1000

    def __post_init__(self) -> None:
        """Raise ValueError for a value outside its range."""
        for name, minimum in (("ticks", 1), ("holdoff_ticks", 0), ("auto_ticks", 1)):
            if (value := getattr(self, name)) < minimum:
                raise ValueError(f"trigger {name}: {value}; allowed: at least {minimum}")
        if not 0 <= self.pre_percent <= 100:
            raise ValueError(f"trigger pre_percent: {self.pre_percent:g}; allowed: 0 … 100")

    @cached_property
    def pre_ticks(self) -> int:
        """Ticks of a sweep before its trigger: `pre_percent` of `ticks` − 1, rounded."""
        return round((self.ticks - 1) * self.pre_percent / 100)


class Trigger:
    """Finds sweeps in stretches of ticks, fed in order; `make_condition` returns a new condition for each run."""

    def __init__(self, settings: Settings, make_condition: Callable[[], Condition]) -> None:
        """Begin armed and without an open sweep. `make_condition` is called now, and again at the first ticks of each
        run in `feed`.
        """
        self._settings, self._make_condition = settings, make_condition
        self._condition = make_condition()
        self._is_armed, self._is_forced = True, False
        self._run, self._next_tick = -1, 0
        self._free_tick = self._ready_tick = 0
        self.open_sweep: Sweep | None = None
        """The sweep that has begun but not ended; None if there is none."""

    def arm(self) -> None:
        """Allow one more sweep in mode single; no effect in the other modes."""
        self._is_armed = True

    def force(self) -> None:
        """Trigger a sweep at the next tick that `feed` gets or, with an open sweep, at the first tick after it, in any
        mode, whether armed or not.
        """
        self._is_forced = True

    def close(self) -> Sweep | None:
        """End the open sweep at the last tick that was fed, remove and return it; None if no sweep is open."""
        sweep, self.open_sweep = self.open_sweep, None
        return None if sweep is None else sweep._replace(end=self._next_tick)

    def feed(self, stretch: Stretch) -> list[Sweep]:
        """Process the next ticks and return the sweeps that end in them, oldest first; [] if there are none.

        A sweep that is triggered in them and ends later is stored in `open_sweep`. The first ticks of a new run discard
        the open sweep; call `close` before them to get it. Raises ValueError if the stretch lacks the condition's
        signal.
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
        """Set `open_sweep` to the next sweep whose trigger lies in the stretch; returns False if there is none.

        The ticks at `indices` of the stretch, ascending, meet the condition; `lost_ticks` is the number of ticks lost
        directly before the stretch. A sweep of any cause ends the effect of `arm` and of `force`.
        """
        settings, tick, cause = self._settings, stretch.end, None
        if settings.mode is not Mode.SINGLE or self._is_armed:
            next_index = bisect_left(indices, self._ready_tick - stretch.first)
            if next_index < len(indices):
                tick, cause = stretch.first + indices[next_index], Cause.TRIGGER
        if self._is_forced and (free_tick := max(self._free_tick, stretch.first)) < tick:
            tick, cause = free_tick, Cause.FORCED
        auto_tick = max(self._ready_tick + settings.auto_ticks, stretch.first)
        if settings.mode is Mode.AUTO and auto_tick < tick:
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

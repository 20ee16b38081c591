"""Trigger conditions: they find the ticks at which a signal meets them, in batches of any length.

A condition receives batches (n,) of its signal, oldest first, and returns the indices of the ticks that meet it,
ascending. It stores the end of one batch for the next. After lost ticks it reports only a change that the first tick
after them still shows: it may miss a trigger, but never invents one. NaN meets no condition. The first tick of a run
meets no condition on a change, because the value before it is unknown.
"""

from __future__ import annotations

import math
from collections import deque
from enum import StrEnum
from typing import Protocol

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.signals import COMMON_SIGNALS, FLAGS, MODE, PERIODS_MISSED, TICK, TRIP_MASK

Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]


class Slope(StrEnum):
    """Direction in which an edge crosses its level."""

    RISING = "rising"
    FALLING = "falling"
    EITHER = "either"


class Condition(Protocol):
    """A trigger condition on the signal `source`."""

    source: str

    def find(self, values: Real, gap: bool) -> Indices:
        """Return the indices in `values` (n,), n > 0, that meet the condition, ascending; [] if none does.

        `values` follow the values of the call before; with `gap`, ticks directly before `values` were lost.
        """
        ...

    def is_exact(self, index: int, gap: bool) -> bool:
        """Return whether the change at `index` of a batch happened at that very tick.

        False only for index 0 with `gap`, as in `find`: the change may have happened in the lost ticks before it.
        """
        return not (gap and index == 0)


class Crossing:
    """Detector for conditions with hysteresis: a sample that is "fired" meets the condition if the last sample before
    it that was "ready" or "fired" was "ready".
    """

    def __init__(self) -> None:
        """Begin without a sample: a "fired" sample meets the condition only after a "ready" one."""
        self._ready = False

    def find(self, is_ready: Mask, is_fired: Mask, gap: bool) -> Indices:
        """Return the indices at which `is_fired` is True for the first time after `is_ready` was True, ascending.

        Both masks are (n,), n > 0, and never True together; the detector continues from the batch before. With `gap`,
        ticks between the two batches were lost: the state before them counts only if `is_fired` holds at index 0.
        """
        indices = np.flatnonzero(is_ready | is_fired)
        if gap and not is_fired[0]:
            self._ready = False
        if indices.size == 0:
            return indices
        ready_states = is_ready[indices]
        previous_ready = np.concatenate([[self._ready], ready_states[:-1]])
        self._ready = bool(ready_states[-1])
        return indices[previous_ready & ~ready_states]


class Edge(Condition):
    """Trigger when the source reaches `level`, after it was more than `hysteresis` (≥ 0) away on the other side.

    Raises ValueError for an unknown slope, a level that is not finite and a hysteresis below 0.
    """

    def __init__(self, source: str, level: float, slope: Slope | str = Slope.RISING, hysteresis: float = 0.0) -> None:
        """Watch `source`; `level` and `hysteresis` are in its unit. Raises ValueError as the class states."""
        if slope not in [*Slope]:
            raise ValueError(f"trigger slope: {slope!r}; allowed: {', '.join(Slope)}")
        _require_finite("trigger level", level)
        _require_not_negative("trigger hysteresis", hysteresis)
        self.source, self._level, self._hysteresis = source, level, hysteresis
        self._rising = Crossing() if slope != Slope.FALLING else None
        self._falling = Crossing() if slope != Slope.RISING else None

    def find(self, values: Real, gap: bool) -> Indices:
        """Return the indices, ascending, in `values` (n,) of the ticks at which the source reaches the level in the
        direction of the slope, after it was more than the hysteresis away on the other side.

        With `gap`, ticks directly before `values` were lost.
        """
        level, hysteresis, indices = self._level, self._hysteresis, []
        if self._rising is not None:
            indices.append(self._rising.find(values < level - hysteresis, values >= level, gap))
        if self._falling is not None:
            indices.append(self._falling.find(values > level + hysteresis, values <= level, gap))
        return np.unique(np.concatenate(indices))


class Window(Condition):
    """Trigger when the source leaves the band from `low` to `high`, both included, in the source's unit.

    Raises ValueError for a limit that is not finite, and unless low < high.
    """

    def __init__(self, source: str, low: float, high: float) -> None:
        """Watch `source`; `low` and `high` are in its unit. Raises ValueError as the class states."""
        _require_finite("trigger window", low)
        _require_finite("trigger window", high)
        if not low < high:
            raise ValueError(f"trigger window: from {low:g} to {high:g}; allowed: the lower end before the higher")
        self.source, self._low, self._high = source, low, high
        self._exit_crossing = Crossing()

    def find(self, values: Real, gap: bool) -> Indices:
        """Return the indices, ascending, in `values` (n,) of each first tick outside the band after a tick inside.

        With `gap`, ticks directly before `values` were lost.
        """
        is_outside = (values < self._low) | (values > self._high)
        return self._exit_crossing.find(~is_outside & ~np.isnan(values), is_outside, gap)


class ChangeCondition(Condition):
    """Base of conditions that compare each sample with the one before it."""

    _last: npt.NDArray | None = None
    """Last sample of the batch before, (1,); None before the first."""

    def _previous_values(self, values: npt.NDArray, gap: bool = False) -> npt.NDArray:
        """Return the sample before each sample of `values`, (n,), and store the last of `values` for the next call.

        The first of all samples, and with `gap` the first of `values`, counts as its own predecessor.
        """
        first = values[:1] if self._last is None or gap else self._last
        self._last = values[-1:].copy()
        return np.concatenate([first, values[:-1]])


class Tripped(ChangeCondition):
    """Trigger when a trip cause appears among the flags, also beside another cause."""

    source = COMMON_SIGNALS[FLAGS].name

    def find(self, values: Real, gap: bool) -> Indices:
        """Return the indices of ticks whose flags in `values` have a trip cause that the tick before did not have.

        `gap` has no effect: after lost ticks the last tick that was read counts as the tick before.
        """
        causes = values.astype(np.int64) & TRIP_MASK
        return np.flatnonzero(causes & ~self._previous_values(causes))


class ModeChanged(ChangeCondition):
    """Trigger when the mode changes."""

    source = COMMON_SIGNALS[MODE].name

    def find(self, values: Real, gap: bool) -> Indices:
        """Return the indices in `values` of the ticks whose mode differs from the mode of the tick before.

        `gap` has no effect: after lost ticks the last tick that was read counts as the tick before.
        """
        return np.flatnonzero(values != self._previous_values(values))


class Late(Condition):
    """Trigger at a tick that started so late that whole periods were missed."""

    source = COMMON_SIGNALS[PERIODS_MISSED].name

    def find(self, values: Real, gap: bool) -> Indices:
        """Return the indices in `values`, the missed periods of each tick, that are above 0; `gap` has no effect."""
        return np.flatnonzero(values > 0)

    def is_exact(self, index: int, gap: bool) -> bool:
        """Return True: each tick records its own missed periods."""
        return True


class Stepped(ChangeCondition):
    """Trigger when the source, such as a reference, changes by more than `threshold` within one tick.

    Raises ValueError for a threshold that is below 0 or not finite.
    """

    def __init__(self, source: str, threshold: float = 0.0) -> None:
        """Watch `source`; `threshold` is in its unit, 0 for any change. Raises ValueError as the class states."""
        _require_not_negative("trigger threshold", threshold)
        self.source, self._threshold = source, threshold

    def find(self, values: Real, gap: bool) -> Indices:
        """Return the indices in `values` (n,) that differ from the value before by more than the threshold.

        The value before the first one is the last value of the call before. With `gap`, ticks between the two were
        lost: then index 0 is left out, because many small changes may have added up.
        """
        previous_values = self._previous_values(values, gap)
        with np.errstate(invalid="ignore", over="ignore"):  # The difference of two infinities is NaN, which is no step.
            return np.flatnonzero(np.abs(values - previous_values) > self._threshold)


class CommandCondition(Condition):
    """Trigger at the ticks in the queue `ticks`, at which commands took effect; `find` removes them from the queue."""

    source = COMMON_SIGNALS[TICK].name

    def __init__(self, ticks: deque[int]) -> None:
        """Watch the queue `ticks`, to which the caller appends ticks of commands in ascending order."""
        self._ticks = ticks

    def find(self, values: Real, gap: bool) -> Indices:
        """Return the indices of the command ticks among the ascending tick numbers `values`.

        Command ticks up to the last of `values` are removed from the queue. With `gap`, ticks before `values` were
        lost: index 0 then stands for the command ticks before `values`, which are else dropped.
        """
        indices: list[int] = []
        while self._ticks and self._ticks[0] <= values[-1]:
            tick = self._ticks.popleft()
            if tick >= values[0] or gap:
                indices.append(int(np.searchsorted(values, tick)))
        return np.unique(np.array(indices, np.intp))


def _require_finite(name: str, value: float) -> None:
    """Raise ValueError unless the value is finite; `name` is the setting's name in the message."""
    if not math.isfinite(value):
        raise ValueError(f"{name}: {value}; allowed: finite numbers")


def _require_not_negative(name: str, value: float) -> None:
    """Raise ValueError unless the value is finite and at least 0; `name` is the setting's name in the message."""
    _require_finite(name, value)
    if value < 0:
        raise ValueError(f"{name}: {value:g}; allowed: 0 or more")

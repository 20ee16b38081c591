"""What a trigger looks for in a signal, at every tick, in whatever lengths the ticks come.

A condition is handed a signal (n,) after the other and returns the places where it is met, in order. It remembers the
signal from one to the next. Of what happened in ticks that were lost in between, it finds what the first tick behind
them still shows, and nothing else: it may have missed something, but never made something up. NaN is neither here nor
there. None of them is met at the first tick of all, for nobody knows what came before.
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
    """Which way an edge goes."""

    RISING = "rising"
    FALLING = "falling"
    EITHER = "either"


class Condition(Protocol):
    """`source` is the signal that it is about."""

    source: str

    def find(self, values: Real, gap: bool) -> Indices:
        """Where in `values` (n,), n > 0, it is met; `gap` says that ticks in front of them were lost."""
        ...

    def is_exact(self, index: int, gap: bool) -> bool:
        """Whether what was found there happened at that very tick, and not in the lost ones before it."""
        return not (gap and index == 0)


class Crossing:
    """From one side to the other, whatever lies in between: the fired side is reached after the ready one."""

    def __init__(self) -> None:
        self._ready = False

    def find(self, is_ready: Mask, is_fired: Mask, gap: bool) -> Indices:
        """Where `is_fired` holds for the first time after `is_ready` did; never both at once."""
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
    """The source reaches `level`, after having been more than `hysteresis` away from it on the other side."""

    def __init__(self, source: str, level: float, slope: Slope | str = Slope.RISING, hysteresis: float = 0.0) -> None:
        if slope not in [*Slope]:
            raise ValueError(f"trigger slope: {slope!r}; {', '.join(Slope)} are allowed")
        _require_finite("trigger level", level)
        _require_finite("trigger hysteresis", hysteresis)
        if hysteresis < 0:
            raise ValueError(f"trigger hysteresis: {hysteresis:g}; 0 or more is allowed")
        self.source, self._level, self._hysteresis = source, level, hysteresis
        self._rising = Crossing() if slope != Slope.FALLING else None
        self._falling = Crossing() if slope != Slope.RISING else None

    def find(self, values: Real, gap: bool) -> Indices:
        """Where the level is reached."""
        level, hysteresis, indices = self._level, self._hysteresis, []
        if self._rising is not None:
            indices.append(self._rising.find(values < level - hysteresis, values >= level, gap))
        if self._falling is not None:
            indices.append(self._falling.find(values > level + hysteresis, values <= level, gap))
        return indices[0] if len(indices) == 1 else np.union1d(*indices)


class Window(Condition):
    """The source leaves the band from `low` to `high`, both of which belong to it."""

    def __init__(self, source: str, low: float, high: float) -> None:
        _require_finite("trigger window", low)
        _require_finite("trigger window", high)
        if not low < high:
            raise ValueError(f"trigger window: from {low:g} to {high:g}; the lower end comes first")
        self.source, self._low, self._high = source, low, high
        self._exit_crossing = Crossing()

    def find(self, values: Real, gap: bool) -> Indices:
        """The first ticks outside."""
        is_outside = (values < self._low) | (values > self._high)
        return self._exit_crossing.find(~is_outside & ~np.isnan(values), is_outside, gap)


class Tripped(Condition):
    """A cause of a trip appears among the flags, beside others or alone."""

    source = COMMON_SIGNALS[FLAGS].name

    def __init__(self) -> None:
        self._previous_causes: int | None = None

    def find(self, values: Real, gap: bool) -> Indices:
        """Where one appears."""
        causes = values.astype(np.int64) & TRIP_MASK
        previous_causes = _previous_values(causes, self._previous_causes)
        self._previous_causes = int(causes[-1])
        return np.flatnonzero(causes & ~previous_causes)


class ModeChanged(Condition):
    """Another mode is in force."""

    source = COMMON_SIGNALS[MODE].name

    def __init__(self) -> None:
        self._previous_mode: float | None = None

    def find(self, values: Real, gap: bool) -> Indices:
        """The first ticks in it."""
        previous_modes = _previous_values(values, self._previous_mode)
        self._previous_mode = float(values[-1])
        return np.flatnonzero(values != previous_modes)


class Late(Condition):
    """A tick woke so late that whole periods were missed."""

    source = COMMON_SIGNALS[PERIODS_MISSED].name

    def find(self, values: Real, gap: bool) -> Indices:
        """The ticks that did."""
        return np.flatnonzero(values > 0)

    def is_exact(self, index: int, gap: bool) -> bool:
        """Always: a tick says it of itself."""
        return True


class Stepped(Condition):
    """The source, such as a reference, changes by more than `threshold` from one tick to the next."""

    def __init__(self, source: str, threshold: float = 0.0) -> None:
        _require_finite("trigger threshold", threshold)
        if threshold < 0:
            raise ValueError(f"trigger threshold: {threshold:g}; 0 or more is allowed")
        self.source, self._threshold = source, threshold
        self._previous_value: float | None = None

    def find(self, values: Real, gap: bool) -> Indices:
        """The ticks with the new value; none behind lost ones, over which a ramp goes far as well."""
        previous_values = _previous_values(values, None if gap else self._previous_value)
        self._previous_value = float(values[-1])
        with np.errstate(invalid="ignore", over="ignore"):  # from infinity to infinity is no step
            return np.flatnonzero(np.abs(values - previous_values) > self._threshold)


class CommandCondition(Condition):
    """A command took effect, as the events say; `ticks` are those at which one did, in order, and are taken away."""

    source = COMMON_SIGNALS[TICK].name

    def __init__(self, ticks: deque[int]) -> None:
        self._ticks = ticks

    def find(self, values: Real, gap: bool) -> Indices:
        """The ticks at which one did; the first one there is, for those that are lost."""
        indices: list[int] = []
        while self._ticks and self._ticks[0] <= values[-1]:
            tick = self._ticks.popleft()
            if tick >= values[0] or gap:
                indices.append(int(np.searchsorted(values, tick)))
        return np.unique(np.array(indices, np.intp))


def _previous_values(values: npt.NDArray, initial_value: float | None) -> npt.NDArray:
    """The value before each one, of the first one `first`, or itself where that is not known."""
    return np.concatenate([values[:1] if initial_value is None else [initial_value], values[:-1]])


def _require_finite(name: str, value: float) -> None:
    if not math.isfinite(value):
        raise ValueError(f"{name}: {value}; a finite number is needed")

"""Robustness of a loop in the frequency domain: crossover, margins, the peak of the sensitivity."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from rtloop.analysis.search import zero_between
from rtloop.foundation.arrays import Complex, Real


class OpenLoop(Protocol):
    """A computed or measured loop whose margins can be read."""

    @cached_property
    def frequencies(self) -> Real:
        """A rising grid of frequencies in Hz."""
        ...

    @property
    def static_gain(self) -> float:
        """Open loop L at 0 Hz: ±inf for an integrating loop, NaN where L is not known."""
        ...

    @property
    def period_s(self) -> float | None:
        """Period in s; None in continuous time, and where L at half the rate is not known."""
        ...

    def open(self, hz: npt.ArrayLike) -> Complex:
        """Return the open loop L at frequencies (k,) in Hz, complex (k,)."""
        ...

    def sensitivity(self, hz: npt.ArrayLike) -> Real:
        """Return |S| = 1/|1 + L| (k,) at frequencies (k,) in Hz."""
        ...


class Margins(NamedTuple):
    """Frequencies in Hz, phase margin in degrees, gain margin as a factor, largest |S|.

    Where |L| never crosses 1, the crossover is NaN and the phase margin inf. Where no larger gain makes the loop
    unstable, the gain margin is inf and its frequency NaN. The phase margin is 0 … 180° and the gain margin above 1 for
    an unstable loop, too: they do not show that it is unstable.
    """

    crossover_hz: float
    phase_margin_deg: float
    gain_margin: float
    gain_margin_hz: float
    max_sensitivity: float
    max_sensitivity_hz: float


def loop_margins(loop: OpenLoop) -> Margins:
    """Return the lowest crossover, the smallest phase margin in degrees over all crossovers, the smallest gain factor >
    1 that brings L to −1, and max |S|.

    Without a crossover it is NaN and the phase margin inf; without such a factor the gain margin is inf.
    """
    hz = loop.frequencies
    response = loop.open(hz)
    crossover_frequencies = gain_crossovers(loop)
    phases = [180 - abs(math.degrees(np.angle(loop.open(f)[0]))) for f in crossover_frequencies]
    gain, gain_hz = _gain_margin(loop, hz, response)
    peak, peak_hz = find_maximum(loop.sensitivity, hz)
    crossover = crossover_frequencies[0] if crossover_frequencies else math.nan
    return Margins(crossover, min(phases, default=math.inf), gain, gain_hz, peak, peak_hz)


def gain_crossovers(loop: OpenLoop) -> list[float]:
    """Return the frequencies in Hz at which |L| of the open loop is 1, rising; [] without one.

    Each is refined between the two points of the grid that enclose it.
    """
    hz = loop.frequencies
    changes = _sign_changes(hz, np.abs(loop.open(hz)) - 1)
    return [zero_between(lambda f: np.abs(loop.open(f)) - 1, *ends) for ends in changes]


def _gain_margin(loop: OpenLoop, hz: Real, response: Complex) -> tuple[float, float]:
    """Return the smallest gain factor > 1 that brings L to −1, and the frequency in Hz; inf, NaN without one.

    `response` (k,) is L at the loop's grid `hz` (k,). At the frequency, L is real, negative and above −1: inside the
    grid, at 0 Hz, or at half the sampling rate.
    """
    real_axis_frequencies = [
        zero_between(lambda f: loop.open(f).imag, *ends) for ends in _sign_changes(hz, np.imag(response))
    ]
    values = [(complex(loop.open(f)[0]), f) for f in real_axis_frequencies]
    values.append((complex(loop.static_gain), 0.0))
    if loop.period_s is not None:
        values.append((complex(loop.open(hz[-1])[0].real), float(hz[-1])))
    margins_ = [(-1 / value.real, f) for value, f in values if -1 < value.real < -1e-12]
    return min(margins_, default=(math.inf, math.nan))


def _sign_changes(hz: Real, values: Real) -> list[tuple[float, float]]:
    """Return pairs of neighbours on the grid, in Hz, between which `values` (k,) changes its sign."""
    indices = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    return [(float(hz[i]), float(hz[i + 1])) for i in indices]


def find_maximum(function: Callable[[Real], Real], hz: Real) -> tuple[float, float]:
    """Return the maximum of `function` over `hz` and its frequency; every peak above 90 % of the highest value is
    refined between grid points.
    """
    values = function(hz)
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
    candidates = [i for i in inner if values[i] > 0.9 * values.max()]
    grid_maximum = (float(values.max()), float(hz[np.argmax(values)]))
    return max([grid_maximum, *(_refine_maximum(function, float(hz[i - 1]), float(hz[i + 1])) for i in candidates)])


def _refine_maximum(function: Callable[[Real], Real], low: float, high: float) -> tuple[float, float]:
    """Return the peak between two frequencies and its frequency, by narrowing a grid about its highest point six
    times.
    """
    maximum = (-math.inf, low)
    for _ in range(6):
        hz = np.linspace(low, high, 21)
        values = function(hz)
        i = int(np.argmax(values))
        maximum = max(maximum, (float(values[i]), float(hz[i])))
        low, high = float(hz[max(i - 1, 0)]), float(hz[min(i + 1, 20)])
    return maximum


def delay_margin(loop: OpenLoop) -> tuple[float, float]:
    """Return the smallest further delay in s that makes the loop unstable, and its crossover in Hz; inf, NaN without
    one.

    The loop must be stable, which is not checked. L exp(−jωτ) meets −1 where |L| = 1 and the phase left above −180°,
    counted downwards, is ωτ.
    """
    phases = [(math.degrees(np.angle(loop.open(f)[0])) % 360 - 180, f) for f in gain_crossovers(loop)]
    return min(((phase_deg % 360 / (360 * f), f) for phase_deg, f in phases), default=(math.inf, math.nan))

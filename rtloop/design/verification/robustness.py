"""How far the plant may move away from its model before the loop is unstable, or misses what it met.

One thing moves at a time. A change of gain stands for D(0), the sensor's scale and all hysteresis weights together: the
slope of P∘P̂⁻¹ is a factor in the loop.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import Loop, continuous_loop, discrete_loop
from rtloop.analysis.loop_analysis import lightest_pair, with_resonance_shifted
from rtloop.analysis.margins import crossings
from rtloop.analysis.search import reach
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.design.verification.judgement import Limit, specified
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.transfer import Transfer

Maker = Callable[[Transfer], Loop]


class Range(NamedTuple):
    """Percent downwards and upwards; `None` where the direction's end was reached without a failure."""

    down: float | None
    up: float | None


class Change(NamedTuple):
    """`apply(plant, percent)`; the search ends at `down` and `up` percent and takes steps of `step`."""

    apply: Callable[[Transfer, float], Transfer]
    down: float
    up: float
    step: float


def with_gain_changed(plant: Transfer, percent: float) -> Transfer:
    """The plant with another gain."""
    return Transfer(plant.zeros, plant.poles, plant.gain * (1 + percent / 100))


def with_damping_changed(plant: Transfer, percent: float) -> Transfer:
    """The plant with the damping ratio of its most lightly damped pair of poles changed; |pole| and D(0) are kept."""
    pair = lightest_pair(plant)
    size, damping = abs(pair), -pair.real / abs(pair) * (1 + percent / 100)
    moved = size * complex(-damping, math.sqrt(1 - damping**2))
    poles = np.where(plant.poles == pair, moved, np.where(plant.poles == np.conj(pair), np.conj(moved), plant.poles))
    return Transfer(plant.zeros, poles, plant.gain)


def changes(plant: Transfer) -> dict[str, Change]:
    """What may move: the resonance, if there is one, its damping, the gain."""
    found = {"gain": Change(with_gain_changed, 99.9, 900.0, 10.0)}
    if np.any(plant.poles.imag > 0):
        pair = lightest_pair(plant)
        most = 100 * (0.999 * abs(pair) / -pair.real - 1) if pair.real < 0 else 0.0
        found = {
            "resonance": Change(with_resonance_shifted, 50.0, 50.0, 0.25),
            "damping": Change(with_damping_changed, 99.9, min(900.0, most), 10.0),
            **found,
        }
    return found


def until_unstable(make: Maker, plant: Transfer, change: Change) -> Range:
    """The range over which `make(plant)` stays stable; (0, 0) if it is not as it stands."""
    return _range(lambda moved: make(moved).is_stable, plant, change)


def until_missed(
    make: Maker, plant: Transfer, change: Change, asked: SpecificationOptions, required: dict[str, Limit]
) -> Range:
    """The range over which every limit of `required` is met; (0, 0) if one is not as it stands."""

    def met(moved: Transfer) -> bool:
        loop = make(moved)
        values = specified(loop, asked) if loop.is_stable else {}
        return bool(values) and all(limit.met(values[name]) for name, limit in required.items())

    return _range(met, plant, change, coarse=4.0, tolerance=0.01)


def _range(
    good: Callable[[Transfer], bool], plant: Transfer, change: Change, coarse: float = 1.0, tolerance: float = 1e-3
) -> Range:
    if not good(plant):
        return Range(0.0, 0.0)
    ends = []
    for sign, largest in ((-1, change.down), (1, change.up)):
        found = reach(
            lambda percent, sign=sign: good(change.apply(plant, sign * percent)),
            largest, coarse * change.step, tolerance,
        )  # fmt: skip
        ends.append(None if found >= largest else found)
    return Range(*ends)


def delay_margin_us(loop: Loop) -> float:
    """The delay that brings a crossover to −1, the least over all of them; infinite without a crossover."""
    if not loop.is_stable:
        return 0.0
    delays = [
        1e6 * (cmath.phase(complex(loop.open(hz)[0])) % (2 * math.pi) - math.pi) % (2e6 * math.pi) / (2 * math.pi * hz)
        for hz in crossings(loop)
    ]
    return min(delays, default=math.inf)


def delay_ticks_tolerated(controller: DiscreteController, plant: Transfer, most: int = 64) -> int:
    """The largest number of samples of delay with which, and with all fewer ones, the loop is stable; −1 if none."""
    for ticks in range(most + 1):
        if not discrete_loop(controller, plant, ticks).is_stable:
            return ticks - 1
    return most


def maker(controller: Transfer | DiscreteController, delay_ticks: int = 0) -> Maker:
    """Loops of one controller with any plant, in continuous time or as it runs."""
    if isinstance(controller, Transfer):
        return lambda plant: continuous_loop(controller, plant)
    return lambda plant: discrete_loop(controller, plant, delay_ticks)

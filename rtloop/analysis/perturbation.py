"""Tolerated changes of a plant, one at a time: frequency and damping of the resonance, gain.

A change of gain stands for D(0), the sensor's scale and all hysteresis weights together: the slope of P∘P̂⁻¹ is a
factor in the loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import Loop, continuous_loop, discrete_loop
from rtloop.analysis.search import find_limit
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.sampled import SampledController
from rtloop.linear.transfer import Transfer

LoopBuilder = Callable[[Transfer], Loop]
"""The loop of one controller with any plant."""


class PercentRange(NamedTuple):
    """Tolerated change in percent downwards and upwards, both as numbers ≥ 0; None: no failure found by the search."""

    down: float | None
    up: float | None


class PlantChange(NamedTuple):
    """A change `apply(plant, percent)` of a plant; a search ends at −`down` and +`up` percent and begins with steps of
    `step` percent.
    """

    apply: Callable[[Transfer, float], Transfer]
    down: float
    up: float
    step: float


def loop_builder(controller: Transfer | DiscreteController | SampledController, delay_ticks: int = 0) -> LoopBuilder:
    """Return a function that builds the loop of one controller, C(s) or C(z), with any plant.

    C(s) ignores `delay_ticks`. The function raises ValueError for a plant with as many zeros as poles and, with C(z),
    for a negative delay.
    """
    if isinstance(controller, Transfer):
        return lambda plant: continuous_loop(controller, plant)
    return lambda plant: discrete_loop(controller, plant, delay_ticks)


def stability_range(build_loop: LoopBuilder, plant: Transfer, change: PlantChange) -> PercentRange:
    """Return the range of a change of `plant`, downwards and upwards in percent (both ≥ 0), over which the loop stays
    stable.

    It is (0, 0) for a loop that is unstable without change; an end is None if the search found no unstable loop on its
    side.
    Raises the errors of `build_loop`.
    """
    return holding_range(lambda changed_plant: build_loop(changed_plant).is_stable, plant, change)


def holding_range(
    holds: Callable[[Transfer], bool],
    plant: Transfer,
    change: PlantChange,
    coarse: float = 1.0,
    tolerance: float = 1e-4,
) -> PercentRange:
    """Return how far a plant may change, downwards and upwards in percent (both ≥ 0), while `holds(plant)` is true.

    The range ends at the nearest failure; it is (0, 0) if `holds` is false without change. An end without a failure, up
    to the end of the search, is None. `coarse` multiplies the steps of the search; the ends are exact to
    `tolerance` percent.
    """
    if not holds(plant):
        return PercentRange(0.0, 0.0)
    ends = []
    for sign, largest in ((-1, change.down), (1, change.up)):
        limit = find_limit(
            lambda percent, sign=sign: holds(change.apply(plant, sign * percent)),
            largest, coarse * change.step, tolerance,
        )  # fmt: skip
        ends.append(None if limit >= largest else limit)
    return PercentRange(*ends)


def change_gain(plant: Transfer, percent: float) -> Transfer:
    """Return the plant with its gain multiplied by 1 + `percent`/100."""
    return Transfer(plant.zeros, plant.poles, plant.gain * (1 + percent / 100))


def change_damping(plant: Transfer, percent: float) -> Transfer:
    """Return the plant with the damping ratio of its least damped pole pair multiplied by 1 + `percent`/100; |pole| and
    D(0) stay.

    Raises ValueError where all poles are real, and for a new damping ratio beyond ±1.
    """
    pair = least_damped_pole(plant)
    size, damping = abs(pair), -pair.real / abs(pair) * (1 + percent / 100)
    new_pole = size * complex(-damping, math.sqrt(1 - damping**2))
    poles = np.where(
        plant.poles == pair, new_pole, np.where(plant.poles == np.conj(pair), np.conj(new_pole), plant.poles)
    )
    return Transfer(plant.zeros, poles, plant.gain)


def plant_changes(plant: Transfer) -> dict[str, PlantChange]:
    """Return the changes of a plant by name: "resonance" and "damping" if it has complex poles, and "gain"."""
    changes_by_name = {"gain": PlantChange(change_gain, 99.9, 900.0, 10.0)}
    if np.any(plant.poles.imag > 0):
        pair = least_damped_pole(plant)
        max_percent = 100 * (0.999 * abs(pair) / -pair.real - 1) if pair.real < 0 else 0.0
        changes_by_name = {
            "resonance": PlantChange(shift_resonance, 50.0, 50.0, 0.25),
            "damping": PlantChange(change_damping, 99.9, min(900.0, max_percent), 10.0),
            **changes_by_name,
        }
    return changes_by_name


def shift_resonance(plant: Transfer, percent: float) -> Transfer:
    """Return the plant with the frequency of its least damped pole pair multiplied by 1 + `percent`/100; damping ratio
    and D(0) stay.

    Raises ValueError for a plant without complex poles.
    """
    pole = least_damped_pole(plant)
    is_resonant = (plant.poles == pole) | (plant.poles == np.conj(pole))
    factor = 1 + percent / 100
    gain = plant.gain * factor ** int(is_resonant.sum())
    return Transfer(plant.zeros, np.where(is_resonant, factor * plant.poles, plant.poles), gain)


def plants_around(plant: Transfer, percent: float, count: int = 5) -> list[tuple[str, Transfer]]:
    """Return (name, plant) of the plant itself and of plants whose resonance is shifted within ±`percent`.

    The names are "the model", then such as "resonance +2 %". The shifts are `count` evenly spaced ones, ends included,
    without a shift of 0. The list has the plant itself alone if it has no resonance, or `percent` is 0.
    """
    plants = [("the model", plant)]
    if percent and np.any(plant.poles.imag > 0):
        shifts = [float(shift) for shift in np.linspace(-percent, percent, count) if shift]
        plants += [(f"resonance {shift:+g} %", shift_resonance(plant, shift)) for shift in shifts]
    return plants


def least_damped_pole(plant: Transfer) -> complex:
    """Return the pole (rad/s) of positive imaginary part with the least damping ratio.

    Raises ValueError where all poles are real.
    """
    upper = plant.poles[plant.poles.imag > 0]
    if not upper.size:
        raise ValueError("plant: all poles are real; allowed: at least one pair of complex poles (a resonance)")
    return complex(upper[np.argmin(-upper.real / np.abs(upper))])


def resonance_hz(plant: Transfer) -> tuple[float, float] | None:
    """Return |s|/2π and −Re s/2π, frequency and half width in Hz, of the least damped pole pair; None if all poles are
    real.
    """
    if not np.any(plant.poles.imag > 0):
        return None
    pair = least_damped_pole(plant)
    return abs(pair) / (2 * math.pi), -pair.real / (2 * math.pi)

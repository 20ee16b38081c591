"""Changes of plant and delay that a loop tolerates before it misses a requirement that it meets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import Loop
from rtloop.analysis.margins import delay_margin
from rtloop.analysis.perturbation import (
    LoopBuilder,
    PercentRange,
    PlantChange,
    holding_range,
    least_damped_pole,
    plant_changes,
    stability_range,
)
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.design.verification.judgement import Limit, specified_quantities
from rtloop.linear.transfer import Transfer


def resonance_frequency(plant: Transfer) -> float | None:
    """Return |s| of the least damped pair of poles in rad/s; None without a pair."""
    return abs(least_damped_pole(plant)) if np.any(plant.poles.imag > 0) else None


def tolerated_shift(make_loop: LoopBuilder, plant: Transfer) -> float:
    """Return the shift of the resonance in percent, the smaller of down and up, for which the loop stays stable.

    Infinite without a limit in the searched range or without a resonance, 0 for an unstable loop.
    """
    resonance = plant_changes(plant).get("resonance")
    tolerated = PercentRange(None, None) if resonance is None else stability_range(make_loop, plant, resonance)
    return min((end for end in tolerated if end is not None), default=math.inf)


class WorstValue(NamedTuple):
    """Worst value of a quantity, and the name of the plant that has it."""

    value: float
    plant: str


Plants = Sequence[tuple[str, Transfer, int]]
"""Name, dynamics and delay in samples of each plant."""
MOST_TRIED_TICKS = 64
"""Largest delay in samples with which a loop is tried."""
LARGER_IS_BETTER = ("bandwidth_hz", "disturbance_hz", "modulus_margin")
"""Quantities whose worst value is the least; of all others it is the largest."""


def worst_values(
    make_loop: Callable[[Transfer, int], Loop],
    plants: Plants,
    specification: SpecificationOptions,
    resonance: float | None,
) -> dict[str, WorstValue]:
    """Return the worst value over `plants`, with the plant's name, of every quantity that a specification can limit.

    `make_loop` takes dynamics and delay in samples; `resonance` is the model's in rad/s, None without one. NaN, from an
    unstable loop, is the worst of all.
    """
    worst_by_quantity = dict[str, WorstValue]()
    for name, plant, delay_ticks in plants:
        for quantity, value in specified_quantities(make_loop(plant, delay_ticks), specification, resonance).items():
            previous = worst_by_quantity.get(quantity)
            if previous is None or _is_worse(value, previous.value, quantity in LARGER_IS_BETTER):
                worst_by_quantity[quantity] = WorstValue(value, name)
    return worst_by_quantity


def _is_worse(value: float, reference_value: float, larger_is_better: bool) -> bool:
    """Whether `value` is worse than the reference; NaN is the worst, and not worse than another NaN."""
    if math.isnan(value) or math.isnan(reference_value):
        return math.isnan(value) and not math.isnan(reference_value)
    return value < reference_value if larger_is_better else value > reference_value


def range_until_missed(
    make_loop: LoopBuilder,
    plant: Transfer,
    change: PlantChange,
    specification: SpecificationOptions,
    required: dict[str, Limit],
) -> PercentRange:
    """Return how far `change` may go, down and up in percent (both ≥ 0), with the loop stable and every limit of
    `required` met.

    (0, 0) if the unchanged loop is unstable or misses one; None for an end without a failure within the search.
    """
    resonance = resonance_frequency(plant)

    def meets_limits(changed_plant: Transfer) -> bool:
        """Whether the loop on `changed_plant` is stable and meets all limits."""
        loop = make_loop(changed_plant)
        values = specified_quantities(loop, specification, resonance) if loop.is_stable else {}
        return bool(values) and all(limit.accepts(values[name]) for name, limit in required.items())

    return holding_range(meets_limits, plant, change, coarse=4.0, tolerance=0.01)


def delay_margin_us(loop: Loop) -> float:
    """Return the least further delay in µs that makes the loop unstable; infinite without a crossover, 0 for an
    unstable loop.
    """
    return 1e6 * delay_margin(loop)[0] if loop.is_stable else 0.0


def tolerated_delay_ticks(delayed_loop: Callable[[int], Loop]) -> int | None:
    """Return the largest delay in samples for which the loop is stable with this and every smaller delay; −1 if the
    loop is unstable without delay, None for one above MOST_TRIED_TICKS.
    """
    for ticks in range(MOST_TRIED_TICKS + 1):
        if not delayed_loop(ticks).is_stable:
            return ticks - 1
    return None

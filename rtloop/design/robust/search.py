"""The search for C(z): short searches from many points, long ones from the best, and more with the proof's worst
plants.

The evolution strategy is the package `cma` (Hansen, "The CMA evolution strategy: a tutorial", 2016).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rtloop.design.robust.certificate import Certificate, certify
from rtloop.design.robust.controller import point_bounds, point_transfer
from rtloop.design.robust.objective import UNSTABLE_COST, Objective, Walls
from rtloop.design.robust.scenarios import Family
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.foundation.arrays import Real
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer

POPULATION, RANDOM_POINTS, SHORT_DIVISOR, CONTINUED_COUNT, ROUNDS = 20, 300, 4, 3, 3
"""Points of a generation; random points of which the best starts a search; divisor of the generations for a short
search; number of searches continued to the end; rounds, before each of which the worst plants of a proof join the
scenarios.
"""
LEAST_FACTOR = 0.9
"""Smallest factor by which one round lowers a limit."""
MISSING_DISTURBANCE_FREQUENCY = (
    "specification.disturbance.up_to_hz: missing; set the frequency in Hz up to which the loop must reject the "
    "disturbance, because no loop rejects a disturbance at all frequencies"
)
"""Fault of a specification with a disturbance that has no largest frequency."""
Progress = Callable[[str], None]


class Minimum(NamedTuple):
    """The best point of a search, (n,), and its cost."""

    point: Real
    cost: float


class RobustDesign(NamedTuple):
    """`controller` in s, to be discretised by "matched"; its family, limits (`walls`), proof (`certificate`), and
    number of scenarios searched over.
    """

    controller: Transfer
    family: Family
    walls: Walls
    certificate: Certificate
    scenario_count: int


def find_robust_controller(design: DesignOptions, progress: Progress = lambda _: None) -> RobustDesign:
    """Find a controller for all scenarios of `design`; `progress` receives a sentence after each search of the first
    round and after each proof.

    Raises ValueError without a plant, for a plant that is unstable, has direct feedthrough or no gain above 0 at 0 Hz,
    and as `design_walls`; NoController if no controller is stable in all scenarios, and, with the missed limits, if the
    last proof misses some.
    """
    plant = design.sensor.add_sensor_lag(design.required_plant.transfer())
    if not plant.is_strictly_proper or plant.dc_gain <= 0 or not plant.is_stable:
        raise ValueError(
            f"plant: plant and sensor together are {'stable' if plant.is_stable else 'not stable'} and have "
            f"{plant.zeros.size} zeros, {plant.order} poles and a gain at 0 Hz of {plant.dc_gain:g}; allowed: stable, "
            "fewer zeros than poles, a gain at 0 Hz above 0"
        )
    options, period_s = design.robust, 1 / design.controller.rate_hz
    family = Family(plant, design.required_plant.delay_ticks, design.scenarios, period_s)
    walls = search_walls = design_walls(design)
    scenarios = family.corner_scenarios()
    random = np.random.default_rng(options.seed)
    minimum, rounds = None, 0
    while True:
        rounds += 1
        objective = Objective(family, scenarios, search_walls, options.biquads)
        if minimum is None:
            minimum = _run_searches(objective, design, random, progress)
        else:
            minimum = minimise(objective, minimum.point, 0.05, options.generations, random)
        if minimum.cost >= UNSTABLE_COST:
            raise NoController(
                f"robust: no controller of order {1 + 2 * options.biquads} found with a stable loop in all "
                f"{len(scenarios)} scenarios; use a smaller scenarios.resonance_percent, fewer values of "
                "scenarios.delay_ticks, or more robust.restarts"
            )
        point = np.clip(minimum.point, *point_bounds(options.biquads))
        controller = point_transfer(point, period_s)
        proof = certify(discretise_controller(controller, period_s, "matched"), family, walls, options.seed)
        violations = proof.violations(walls, options.decay_ms)
        progress(f"proof over {proof.plants} plants: " + ("; ".join(violations) or "all limits are met"))
        if not violations or rounds == ROUNDS:
            break
        scenarios = list(dict.fromkeys([*scenarios, *proof.worst_scenarios()]))
        search_walls = _tighten(search_walls, walls, proof)
    if violations:
        raise NoController(
            "robust: the best controller found misses limits: "
            + "; ".join(violations)
            + ". Use wider limits, smaller ranges in [scenarios], or more robust.restarts or robust.biquads"
        )
    return RobustDesign(controller, family, walls, proof, len(scenarios))


def minimise(
    cost: Callable[[Real], Real], start: Real, spread: float, generations: int, random: np.random.Generator
) -> Minimum:
    """Minimise `cost`, which takes points (k, n) and returns (k,), from `start` (n,) with standard deviation `spread`.

    All random numbers come from `random`. Returns `start` if no point of any generation is better.
    """
    import cma  # takes a second: only a search needs it

    options = {
        "popsize": POPULATION,
        "maxiter": generations,
        "randn": lambda *shape: random.standard_normal(shape),
        "seed": np.nan,  # leave numpy's own generator alone
        "verbose": -10,  # say nothing, and read no options from the working directory
        "verb_log": 0,
    }
    strategy, minimum = cma.CMAEvolutionStrategy(start, spread, options), Minimum(start, float(cost(start[None])[0]))
    while not strategy.stop():
        points = np.array(strategy.ask())
        costs = cost(points)
        strategy.tell(points, costs)
        index = int(np.argmin(costs))
        if costs[index] < minimum.cost:
            minimum = Minimum(points[index], float(costs[index]))
    return minimum


def design_walls(design: DesignOptions) -> Walls:
    """Return the limits from [robust] and the disturbance; without a disturbance, `disturbance_hz` is 0.

    Raises ValueError for an up_to_hz that is missing or not below half the rate.
    """
    options, disturbance = design.robust, design.specification.disturbance
    if disturbance is None:
        return Walls(options.largest_sensitivity, options.noise_gain, 1.0, 0.0)
    if disturbance.up_to_hz is None:
        raise ValueError(MISSING_DISTURBANCE_FREQUENCY)
    if disturbance.up_to_hz >= design.controller.rate_hz / 2:
        raise ValueError(
            f"specification.disturbance.up_to_hz: {disturbance.up_to_hz:g} Hz; allowed: below half of "
            f"controller.rate_hz, {design.controller.rate_hz / 2:g} Hz"
        )
    return Walls(
        options.largest_sensitivity, options.noise_gain, disturbance.error_um / disturbance.largest_um,
        disturbance.up_to_hz,
    )  # fmt: skip


def _tighten(search_walls: Walls, walls: Walls, proof: Certificate) -> Walls:
    """Return limits for another round of the search: `search_walls`, each multiplied by limit/value if the value in the
    proof exceeds the limit in the requested `walls`, but at least by LEAST_FACTOR; the limit on |S| stays 1 or more.

    A peak may lie between the frequencies and scenarios of a search.
    """
    cases = [(proof.sensitivity, walls.sensitivity), (proof.noise_gain, walls.noise_gain),
             (proof.disturbance, walls.disturbance)]  # fmt: skip
    factors = [limit / case.value if limit < case.value < math.inf else 1.0 for case, limit in cases]
    sensitivity, noise, disturbance = (max(factor, LEAST_FACTOR) for factor in factors)
    return Walls(
        max(1.0, sensitivity * search_walls.sensitivity),
        noise * search_walls.noise_gain,
        disturbance * search_walls.disturbance,
        walls.disturbance_hz,
    )


def _run_searches(
    objective: Objective, design: DesignOptions, random: np.random.Generator, progress: Progress
) -> Minimum:
    """Run `restarts` short searches and continue the best CONTINUED_COUNT; return the best point of all."""
    options, minima = design.robust, list[Minimum]()
    for number in range(options.restarts):
        points = _random_points(objective, options.biquads, random)
        start = points[np.argmin(objective(points))]
        minima.append(minimise(objective, start, 0.3, max(1, options.generations // SHORT_DIVISOR), random))
        progress(f"search {number + 1} of {options.restarts}: {_describe_minimum(objective, minima[-1])}")
    best_minima = sorted(minima, key=lambda minimum: minimum.cost)[:CONTINUED_COUNT]
    for number, minimum in enumerate(best_minima):
        minima.append(minimise(objective, minimum.point, 0.1, options.generations, random))
        progress(f"continued search {number + 1} of {len(best_minima)}: {_describe_minimum(objective, minima[-1])}")
    return min(minima, key=lambda minimum: minimum.cost)


def _random_points(objective: Objective, sections: int, random: np.random.Generator) -> Real:
    """Return RANDOM_POINTS random points (k, n) with low gains and sections near the resonance; some may lie outside
    the bounds of the search.
    """
    middle = (
        np.log(np.mean(objective.bands) * objective.period_s) if np.all(np.isfinite(objective.bands)) else np.log(0.3)
    )
    centre = np.array([np.log(0.02), np.log(0.05), *([middle, 0.0, middle, np.log(0.5)] * sections)])
    spread = np.array([1.0, 1.0, *([0.7, 0.7, 0.7, 0.5] * sections)])
    return centre + spread * random.standard_normal((RANDOM_POINTS, centre.size))


def _describe_minimum(objective: Objective, minimum: Minimum) -> str:
    """Return the measures of a search's best point as text; for an unstable one, its largest |pole| alone."""
    measures = objective.measure(np.clip(minimum.point, objective.low, objective.high)[None])
    if minimum.cost >= UNSTABLE_COST:
        return f"unstable, largest |pole| {measures.radius[0]:.4f}"
    decays_ms = "/".join(f"{1e3 * value:.3f}" for value in measures.decay_s[0])
    return (
        f"slowest decay {decays_ms} ms, max |S| {measures.sensitivity[0]:.3f}, "
        f"noise gain {measures.noise_gain[0]:.2f}, |S| at the disturbance {measures.disturbance[0]:.4f}"
    )

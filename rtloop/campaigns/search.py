"""Search of the worst rig, and of the boundary between rigs that pass and rigs that fail.

The worst rig is found by differential evolution (Storn and Price 1997, scipy's), which begins with a Sobol set over all
uncertain keys. The boundary lies along one key: steps from the nominal value to the first failure, then bisection.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from typing import Any, NamedTuple

import numpy as np

from rtloop.campaigns.campaign_file import Campaign
from rtloop.campaigns.case import NOMINAL, CaseResult, CaseRunner
from rtloop.campaigns.samples import unit_samples
from rtloop.campaigns.unit import WorkerFacts, run_values
from rtloop.campaigns.workers import WorkerDied, Workers
from rtloop.errors import ConfigError, LoopFault
from rtloop.foundation.arrays import Real

POPULATION_PER_KEY, SMALLEST_POPULATION = 8, 16
"""Rigs of a generation for each key, and at least."""
TRIP_RATIO = 1e6
"""Stands for the infinite ratio of a rig that trips, which no optimiser can order."""
BOUNDARY_STEPS, BISECTIONS = 32, 20
"""Steps from the nominal value to an end of the range, and halvings of the step in which a failure was found."""

Evaluate = Callable[[Sequence[tuple[int, Mapping[str, object]]]], Sequence[CaseResult]]
"""Runs rigs, each with a number and values by key, and returns their results in the same order."""


class SearchResult(NamedTuple):
    """Worst rig of a search, the value of the figure that was maximised, and the number of rigs that were tried.

    `figure` is infinite where the rig tripped or its value is not finite.
    """

    worst: CaseResult
    figure: float
    rigs: int


class Boundary(NamedTuple):
    """Range of a key around its nominal value in which every tried rig passes.

    An end is None, and its cause "", where no rig up to the end of the key's distribution failed. Else `low_cause` and
    `high_cause` name the limits that the failing rig nearest to the end misses, or why it cannot run. Both ends are the
    nominal value if the nominal rig fails. `rigs` is the number of rigs that were tried.
    """

    key: str
    low: float | None
    high: float | None
    low_cause: str
    high_cause: str
    rigs: int


def evaluate_on(workers: Workers, campaign: Campaign) -> Evaluate:
    """Return a function that runs rigs of a campaign on workers, spread evenly over them.

    The function raises LoopFault if a worker dies, UnavailableError if the scheduler is gone, and as `run_values`.
    """
    facts = WorkerFacts.of_this_process()

    def evaluate(rigs: Sequence[tuple[int, Mapping[str, object]]]) -> list[CaseResult]:
        """Run the rigs and return their results in the same order."""
        size = max(math.ceil(len(rigs) / workers.count), 1)
        parts = [rigs[first : first + size] for first in range(0, len(rigs), size)]
        futures = [workers.submit(run_values, campaign, part, facts) for part in parts]
        try:
            return [case for future in futures for case in future.result()]
        except (Exception, CancelledError) as raised:
            error = workers.explain(raised)
            if isinstance(error, WorkerDied):
                raise LoopFault(
                    "a rig killed its worker process; `rtloop campaign run` names such rigs and goes on without them"
                ) from None
            raise error from None

    return evaluate


def find_worst(
    runner: CaseRunner, evaluate: Evaluate, rigs: int, figure: str = "", target: float = math.inf
) -> SearchResult:
    """Return the rig with the largest `figure`, or with "" the largest ratio, among about `rigs` tried rigs.

    Whole generations of differential evolution run, at least one; the search ends early after a generation whose figure
    reaches `target`. A rig that is refused counts with the figure 0, one that trips or whose figure is not finite as
    the worst. Raises ConfigError for an unknown figure, for keys without numbers, and for the ratio of a campaign
    without limits; and as `evaluate` does.
    """
    from scipy.optimize import differential_evolution

    _check_search(runner, figure)
    worst_cases: list[tuple[float, CaseResult]] = []  # one, the worst so far; none before the first generation
    count = 0

    def run_generation(_: object, candidates: Real) -> list[float]:
        """Run the rigs at `candidates` (rigs, keys), shares of the distributions; return the negative figures.

        Stores the worst rig of all generations in `worst_cases`.
        """
        nonlocal count
        numbered = []
        for shares in candidates:
            count += 1
            numbered.append((count, runner.quantile_values(count, np.clip(shares, 1e-9, 1 - 1e-9))))
        heights = []
        for case in evaluate(numbered):
            height = _height(case, figure)
            heights.append(height)
            if not worst_cases or height > worst_cases[0][0]:
                worst_cases[:] = [(height, case)]
        return [-height for height in heights]

    keys = len(runner.keys)
    population = max(SMALLEST_POPULATION, POPULATION_PER_KEY * keys)
    population = 1 << (population - 1).bit_length()  # Sobol's sequence is even for powers of two
    settings: dict[str, Any] = {
        "init": unit_samples("sobol", runner.keys, 0, population, population, runner.options.seed),
        "maxiter": max(math.ceil(rigs / population) - 1, 0),
        "strategy": "best1bin",
        "tol": 0.0,
        "atol": 0.0,
        "polish": False,
        "updating": "deferred",
        "workers": run_generation,
        "rng": np.random.Generator(np.random.PCG64(runner.options.seed)),
        "callback": lambda intermediate_result: -intermediate_result.fun >= target,
    }
    differential_evolution(lambda shares: 0.0, [(0.0, 1.0)] * keys, **settings)
    height, case = worst_cases[0]
    return SearchResult(case, math.inf if height == TRIP_RATIO else height, count)


def find_boundary(runner: CaseRunner, key: str, evaluate: Evaluate, tolerance: float = 0.0) -> Boundary:
    """Return the range of `key` around its nominal value in which rigs pass, all other keys at their nominal values.

    An end is None where no tried rig fails; both are the nominal value if the nominal rig fails. The noise is the
    nominal rig's. Bisection ends at `tolerance`, in the key's unit, or after BISECTIONS halvings. Raises ConfigError
    for a key that is not uncertain, has no range of numbers or no configured value; and as `evaluate` does.
    """
    distribution = runner.options.uncertain.get(key)
    if distribution is None or distribution.choice is not None:
        allowed = ", ".join(name for name, options in runner.options.uncertain.items() if options.choice is None)
        raise ConfigError(runner.campaign.name, [f"boundary: {key!r}; allowed: {allowed or 'keys with a range'}"])
    nominal, count = runner.sample_values(NOMINAL), 0

    def failure(value: float) -> str:
        """Return the missed limits or the refusal of the rig with this value of the key; "" if it passes."""
        nonlocal count
        count += 1
        (case,) = evaluate([(count, {**nominal, key: value})])
        return case.refusal or "; ".join(case.missed)

    if nominal[key] is None:
        raise ConfigError(runner.campaign.name, [f"boundary: {key!r} has no value in the configuration; set a value"])
    begin = float(nominal[key])
    if cause := failure(begin):
        return Boundary(key, begin, begin, cause, cause, count)
    ends = []
    low_end, high_end = sorted(float(runner.quantile_value(key, share)) for share in (1e-9, 1 - 1e-9))
    for end in (min(low_end, begin), max(high_end, begin)):
        last_good, cause = begin, ""
        for value in np.linspace(begin, end, BOUNDARY_STEPS + 1)[1:].tolist() if end != begin else ():
            if cause := failure(value):
                last_good, cause = _bisect(failure, last_good, value, cause, tolerance)
                break
            last_good = value
        ends.append((last_good if cause else None, cause))
    (low, low_cause), (high, high_cause) = ends
    return Boundary(key, low, high, low_cause, high_cause, count)


def _bisect(
    failure: Callable[[float], str], passing: float, failing: float, cause: str, tolerance: float
) -> tuple[float, str]:
    """Return the passing value next to a failure, by bisection between `passing` and `failing`, and the failure's
    cause.

    `failure` returns the cause at a value, "" if it passes; `cause` belongs to `failing`. Bisection ends at `tolerance`
    or after BISECTIONS halvings.
    """
    for _ in range(BISECTIONS):
        if abs(failing - passing) <= tolerance:
            break
        middle = (passing + failing) / 2
        middle_cause = failure(middle)
        if middle_cause:
            failing, cause = middle, middle_cause
        else:
            passing = middle
    return passing, cause


def _check_search(runner: CaseRunner, figure: str) -> None:
    """Raise ConfigError for a figure, keys or limits with which no worst rig can be searched."""
    options, name = runner.options, runner.campaign.name
    if figure and figure not in options.figures:
        raise ConfigError(name, [f"figure: {figure!r}; allowed: {', '.join(options.figures)}"])
    if not figure and not runner.campaign.limits:
        raise ConfigError(
            name,
            [
                "limits: the campaign has none by which rigs could be ranked; set [limits] in its file, or name the "
                f"result to maximise with --figure: {', '.join(options.figures)}"
            ],
        )
    words = [key for key, distribution in options.uncertain.items() if not distribution.is_numeric]
    if words:
        raise ConfigError(
            name, [f"uncertain.{key}: the choices are not all numbers; a search needs numbers" for key in words]
        )


def _height(case: CaseResult, figure: str) -> float:
    """Return the value that a search maximises: the case's `figure`, or its ratio if `figure` is empty.

    The value is TRIP_RATIO for a rig that tripped, whatever the figure, and in place of a value that is not finite; 0
    for a refused rig, which never ran.
    """
    if case.refusal:
        return 0.0
    height = case.figures[figure] if figure else case.ratio
    return height if math.isfinite(height) and not any(case.trips.values()) else TRIP_RATIO

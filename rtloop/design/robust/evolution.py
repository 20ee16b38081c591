"""CMA-ES: minimise a function of a few numbers that has many minima and no useful gradient.

Points are drawn around a mean with a covariance that learns from the best half of each generation: Hansen, "The CMA
evolution strategy: a tutorial", 2016, with its default constants. Coordinates should be scaled to about 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rtloop.hil.modal import Real

WORSE = 1e-9
"""A relative gain below this over a whole window of generations ends a search."""


class Minimum(NamedTuple):
    """The best point found, (n,), and its cost."""

    point: Real
    cost: float


def evolve(
    cost: Callable[[Real], Real],
    start: Real,
    spread: float,
    generations: int,
    random: np.random.Generator,
    population: int | None = None,
    window: int = 100,
) -> Minimum:
    """Minimise `cost`, which takes points (k, n) and gives (k,), from `start` (n,) and standard deviation `spread`."""
    n = start.size
    count = population or 4 + int(3 * math.log(n))
    half = count // 2
    weights = math.log((count + 1) / 2) - np.log(np.arange(1, half + 1))
    weights /= weights.sum()
    effective = 1 / float(np.sum(weights**2))
    c_sigma = (effective + 2) / (n + effective + 5)
    damping = 1 + 2 * max(0.0, math.sqrt((effective - 1) / (n + 1)) - 1) + c_sigma
    c_path = (4 + effective / n) / (n + 4 + 2 * effective / n)
    c_one = 2 / ((n + 1.3) ** 2 + effective)
    c_rest = min(1 - c_one, 2 * (effective - 2 + 1 / effective) / ((n + 2) ** 2 + effective))
    expected = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    mean, covariance, sigma = start.astype(float), np.eye(n), spread
    path, path_sigma = np.zeros(n), np.zeros(n)
    best = Minimum(mean, float(cost(mean[None])[0]))
    history: list[float] = []
    for generation in range(generations):
        values, axes = np.linalg.eigh(covariance)
        lengths = np.sqrt(np.maximum(values, 1e-20))
        steps = (random.standard_normal((count, n)) * lengths) @ axes.T
        points = mean + sigma * steps
        costs = cost(points)
        order = np.argsort(costs, kind="stable")
        if costs[order[0]] < best.cost:
            best = Minimum(points[order[0]], float(costs[order[0]]))
        history.append(best.cost)
        if generation >= window and history[-window] - best.cost <= WORSE * abs(best.cost):
            break
        chosen = steps[order[:half]]
        step = weights @ chosen
        mean = mean + sigma * step
        whitened = axes @ ((axes.T @ step) / lengths)
        path_sigma = (1 - c_sigma) * path_sigma + math.sqrt(c_sigma * (2 - c_sigma) * effective) * whitened
        size = float(np.linalg.norm(path_sigma))
        moving = size / math.sqrt(1 - (1 - c_sigma) ** (2 * (generation + 1))) < (1.4 + 2 / (n + 1)) * expected
        path = (1 - c_path) * path + moving * math.sqrt(c_path * (2 - c_path) * effective) * step
        kept = 1 - c_one - c_rest + (not moving) * c_one * c_path * (2 - c_path)
        covariance = kept * covariance + c_one * np.outer(path, path) + c_rest * (chosen.T * weights) @ chosen
        sigma *= math.exp(min(1.0, (c_sigma / damping) * (size / expected - 1)))
    return best

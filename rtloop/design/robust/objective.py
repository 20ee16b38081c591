"""Cost function of the search: the slowest decay around the resonances over all scenarios, with limits as penalties.

    cost = log(τ/T) + 10 Σ max(0, log(value/(0.99 limit))) stable in every scenario; with two leading modes
                                                           half the worst, half the mean of both log(τ/T)
         = UNSTABLE_COST·(1 + largest |pole|)                         otherwise

All values are computed for many controllers and all scenarios at once; the certificate does not use this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import sampled_plant
from rtloop.design.robust.controller import build_candidates, point_bounds
from rtloop.design.robust.scenarios import Family, Scenario
from rtloop.foundation.arrays import Complex, Real
from rtloop.linear.realisation import System

UNSTABLE_COST, WALL_SLOPE = 100.0, 10.0
INSIDE_SHARE = 0.99
"""Fraction of a limit that a search aims at, because of the gaps between its frequencies and its scenarios."""


class Walls(NamedTuple):
    """Limits on max |S|, on |S| at `disturbance_hz` (0: no such limit), and on the rms of v per rms of the sensor's
    noise.
    """

    sensitivity: float
    noise_gain: float
    disturbance: float
    disturbance_hz: float


class Measures(NamedTuple):
    """The worst over all scenarios, (k,): largest |pole|, slowest 1/|Re s| in s of each band (k, bands), max |S|, |S|
    at the disturbance's frequency (0 without one), rms of v per rms of sensor noise.
    """

    radius: Real
    decay_s: Real
    sensitivity: Real
    disturbance: Real
    noise_gain: Real


class Objective:
    """Cost of points, the numbers of controllers with `sections` of second order (`build_candidates`), over scenarios.

    `low` and `high` (n,) bound a point, `shares` (f,) are the weights of the frequencies in the noise gain, `plants`
    the stacked matrices of the scenarios and `responses` (scenarios, f) their responses at `z` (f,).
    """

    def __init__(self, family: Family, scenarios: Sequence[Scenario], walls: Walls, sections: int):
        """Prepare plants and frequencies for controllers with `sections` second-order sections, limited by `walls`."""
        self.walls, self.period_s = walls, family.period_s
        self.low, self.high = point_bounds(sections)
        self.bands = family.bands if family.modes.size else np.array([[0.0, np.inf]])
        plants = [
            sampled_plant(family.plant(scenario), family.period_s, scenario.delay_ticks) for scenario in scenarios
        ]
        self.plants = _stack_plants(plants)
        hz, self.shares = _frequency_grid(family, walls)
        self.z = np.exp(2j * np.pi * hz * family.period_s)
        self.responses = np.array([plant.response(self.z) for plant in plants])

    def __call__(self, points: Real) -> Real:
        """Return costs (k,) of points (k, n): the log of the slowest decay in periods, half of the worst band and half
        of the bands' mean, plus WALL_SLOPE times the log of each excess over INSIDE_SHARE of a limit.

        Outside the bounds, the cost is the cost of the nearest point inside plus the squared distance. An unstable
        point costs at least UNSTABLE_COST.
        """
        clipped = np.clip(points, self.low, self.high)
        measures, walls = self.measure(clipped), self.walls
        limited = [(measures.sensitivity, walls.sensitivity), (measures.noise_gain, walls.noise_gain)]
        if walls.disturbance_hz:
            limited.append((measures.disturbance, walls.disturbance))
        with np.errstate(invalid="ignore"):
            excess = sum(np.maximum(0, np.log(value / (INSIDE_SHARE * limit))) for value, limit in limited)
            decay = np.log(np.maximum(measures.decay_s / self.period_s, 1.0))
            cost = 0.5 * (decay.max(axis=1) + decay.mean(axis=1)) + WALL_SLOPE * excess
        cost = np.where(
            (measures.radius < 1) & np.isfinite(cost),
            cost,
            UNSTABLE_COST * (1 + np.minimum(measures.radius, UNSTABLE_COST)),
        )
        return cost + np.sum((points - clipped) ** 2, axis=1)

    def measure(self, points: Real) -> Measures:
        """Return the worst value of each quantity over the scenarios for points (k, n), which must be within bounds."""
        controllers = build_candidates(points)
        z_poles = self._closed_loop_poles(*controllers.matrices())
        rates = np.log(np.maximum(np.abs(z_poles), 1e-300)) / self.period_s
        sizes = np.abs(np.angle(z_poles)) / self.period_s
        time_constants = -1 / np.minimum(rates, -1e-9)
        decay = np.stack([_slowest_constant(time_constants, sizes, low, high) for low, high in self.bands], axis=1)
        controller = controllers.response(self.z)
        sensitivity = 1 / np.abs(1 + controller[:, None] * self.responses)
        noise = np.sqrt((np.abs(controller[:, None]) * sensitivity) ** 2 @ self.shares)
        at_disturbance = sensitivity[:, :, 0] if self.walls.disturbance_hz else np.zeros(sensitivity.shape[:2])
        return Measures(
            np.abs(z_poles).max(axis=(1, 2)),
            decay,
            sensitivity.max(axis=(1, 2)),
            at_disturbance.max(axis=1),
            noise.max(axis=1),
        )

    def _closed_loop_poles(self, a: Real, b: Real, c: Real, d: Real) -> Complex:
        """Return the closed-loop poles in z, (k, scenarios, n), of controllers with matrices (k, …)."""
        ap, bp, cp = self.plants
        n, order = a.shape[1], a.shape[1] + ap.shape[1]
        joint = np.zeros((a.shape[0], ap.shape[0], order, order))
        joint[:, :, :n, :n] = a[:, None]
        joint[:, :, :n, n:] = -b[:, None, :, None] * cp[None, :, None, :]
        joint[:, :, n:, :n] = bp[None, :, :, None] * c[:, None, None, :]
        joint[:, :, n:, n:] = ap - (d[:, None, None] * bp)[..., None] * cp[:, None, :]
        return np.linalg.eigvals(joint).astype(complex)


def _slowest_constant(constants: Real, sizes: Real, low: float, high: float) -> Real:
    """Return the largest (k,) of the time constants in s, `constants` (k, scenarios, n), whose pole has its |Im s| in
    rad/s, in `sizes`, from `low` to `high`.

    In a scenario without such a pole, all poles count.
    """
    is_counted = (sizes >= low) & (sizes <= high)
    is_counted |= ~is_counted.any(axis=2, keepdims=True)
    return np.where(is_counted, constants, 0.0).max(axis=(1, 2))


def _stack_plants(plants: Sequence[System]) -> tuple[Real, Real, Real]:
    """Return stacked A (k, n, n), b (k, n), c (k, n) of k plants; smaller ones are padded with states that are neither
    driven nor observed.
    """
    order = max(plant.b.size for plant in plants)
    a, b, c = (np.zeros((len(plants), *shape)) for shape in ((order, order), (order,), (order,)))
    for i, plant in enumerate(plants):
        n = plant.b.size
        a[i, :n, :n], b[i, :n], c[i, :n] = plant.a, plant.b, plant.c
    return a, b, c


def _frequency_grid(family: Family, walls: Walls) -> tuple[Real, Real]:
    """Return frequencies in Hz and the weight of each in a mean over 0 Hz … half the rate, both (f,).

    The first frequency, with weight 0, is the disturbance's; the lowest of the grid if that is lower or 0 (none).
    """
    top = 0.5 / family.period_s
    grids = [np.geomspace(1e-4 * top, 0.999 * top, 110), np.linspace(0.02 * top, 0.999 * top, 40)]
    for mode in np.abs(family.modes) / (2 * np.pi):
        grids += [np.linspace(0.5 * mode, 2 * mode, 50), np.linspace(0.85 * mode, 1.15 * mode, 60)]
    hz = np.unique(np.minimum(np.concatenate(grids), 0.999 * top))
    edges = np.concatenate([[0.0], 0.5 * (hz[1:] + hz[:-1]), [top]])
    return np.append(max(walls.disturbance_hz, hz[0]), hz), np.append(0.0, np.diff(edges) / top)

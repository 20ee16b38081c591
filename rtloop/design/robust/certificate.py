"""Certificate of a designed controller, independent of the search: poles and |S| of each assembled running loop.

The search uses a grid of scenarios and frequencies; the certificate uses sweeps of all parameters and random plants.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import Loop, discrete_loop
from rtloop.analysis.margins import find_maximum
from rtloop.design.robust.objective import Walls
from rtloop.design.robust.scenarios import Family, Scenario
from rtloop.design.verification.judgement import noise_gains
from rtloop.linear.discretise import DiscreteController

SWEEP_POINTS, RANDOM_PLANTS = 41, 200


class WorstCase(NamedTuple):
    """A value and its scenario."""

    value: float
    scenario: Scenario


class Certificate(NamedTuple):
    """Worst of `plants` plants, each with its scenario.

    Largest |pole|, 1/|Re s| in ms of the slowest mode in the family's bands, max |S|, |S| at the disturbance's
    frequency, noise gain; all but the first are infinite if a loop is unstable.
    """

    plants: int
    radius: WorstCase
    decay_ms: WorstCase
    sensitivity: WorstCase
    disturbance: WorstCase
    noise_gain: WorstCase

    @property
    def is_stable(self) -> bool:
        """Whether every loop is stable."""
        return self.radius.value < 1

    def violations(self, walls: Walls, decay_ms: float | None) -> list[str]:
        """Return a text for each limit that a scenario exceeds; [] if there is none.

        `walls` limit |S|, |S| at the disturbance and the noise gain; `decay_ms` limits the slowest mode's time constant
        (None: no limit). If a loop is unstable, the only text says so.
        """
        if not self.is_stable:
            return [f"unstable with {self.radius.scenario} (largest |pole| {self.radius.value:.5f})"]
        checks = [
            ("max |S|", self.sensitivity, walls.sensitivity),
            (f"|S| at {walls.disturbance_hz:g} Hz", self.disturbance, walls.disturbance),
            ("noise gain from sensor to v", self.noise_gain, walls.noise_gain),
            ("time constant in ms of the slowest mode around a resonance", self.decay_ms, decay_ms or math.inf),
        ]
        return [
            f"{name} is {case.value:.4g} with {case.scenario}; allowed: up to {limit:.4g}"
            for name, case, limit in checks
            if case.value > limit * (1 + 1e-9)
        ]

    def worst_scenarios(self) -> list[Scenario]:
        """Return the worst scenario of each measure, without duplicates."""
        return list(dict.fromkeys(case.scenario for case in self[1:]))


def certify(controller: DiscreteController, family: Family, walls: Walls, seed: int = 0) -> Certificate:
    """Return the certificate of a controller over a family's corners, sweeps and random draws (`seed`): the worst value
    of each measure, with its scenario.

    Only the disturbance's frequency of `walls` is used; `Certificate.violations` checks the limits.
    """
    scenarios = dict.fromkeys(
        [
            *family.corner_scenarios(),
            *family.sweep_scenarios(SWEEP_POINTS),
            *family.random_scenarios(RANDOM_PLANTS, seed),
        ]
    )
    measures = {scenario: _measure_loop(controller, family, walls, scenario) for scenario in scenarios}
    cases = [WorstCase(*max((values[i], scenario) for scenario, values in measures.items())) for i in range(5)]
    return Certificate(len(measures), *cases)


def slowest_ms(loop: Loop, bands: Iterable[tuple[float, float]]) -> float:
    """Return 1/|Re s| in ms of the slowest closed-loop mode whose |Im s| is in one of the bands (rad/s); of the slowest
    of all modes if a band has no mode, or without bands; inf if the loop is unstable.
    """
    if not loop.is_stable:
        return math.inf
    sizes, all_bands = np.abs(loop.rates.imag), list(bands)
    is_counted = np.full(sizes.shape, not all_bands)
    for low, high in all_bands:
        is_in_band = (sizes >= low) & (sizes <= high)
        is_counted |= is_in_band if is_in_band.any() else True
    return float(np.max(-1e3 / loop.rates.real[is_counted], initial=0.0))


def noise_gain(loop: Loop) -> float:
    """Return the rms of the command v per rms of white sensor noise, from the stationary covariance of a stable sampled
    loop.
    """
    return float(noise_gains(loop)[1])


def _measure_loop(
    controller: DiscreteController, family: Family, walls: Walls, scenario: Scenario
) -> tuple[float, float, float, float, float]:
    """Return largest |pole|, `slowest_ms`, max |S|, |S| at the disturbance's frequency (0 without a disturbance), noise
    gain; all but the first are infinite if the loop is unstable.
    """
    loop = discrete_loop(controller, family.plant(scenario), scenario.delay_ticks)
    radius = float(np.max(np.abs(loop.poles)))
    if not loop.is_stable:
        return radius, math.inf, math.inf, math.inf, math.inf
    disturbance = float(loop.sensitivity(walls.disturbance_hz)[0]) if walls.disturbance_hz else 0.0
    decay = slowest_ms(loop, family.bands)
    peak, _ = find_maximum(loop.sensitivity, loop.frequencies)
    return radius, decay, peak, disturbance, noise_gain(loop)

"""Plants around a model: combinations for a search, sweeps and random draws for a proof."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from rtloop.analysis.comparison import LIGHT_DAMPING
from rtloop.design.robust.options import ScenarioOptions
from rtloop.foundation.arrays import Complex, Real
from rtloop.linear.transfer import Transfer

MODE_BAND = (0.55, 1.85)
"""Closed-loop modes between these multiples of a lightly damped mode's frequency are judged by their decay."""
LEADING_COUNT = 2
"""Number of lightly damped modes that are shifted in every combination: the highest peaks."""


class Scenario(NamedTuple):
    """Percent on the frequency of each lightly damped mode, factor on its damping, percent on the gain, delay ticks."""

    resonance: tuple[float, ...]
    damping: float
    gain: float
    delay_ticks: int

    def __str__(self) -> str:
        """Return all changes, also those by 0, as one line: "resonance +10/+0 %, damping × 0.5, gain -5 %, delay_ticks
        2", with a resonance for each mode, and none without modes.
        """
        parts = [f"resonance {'/'.join(f'{percent:+.3g}' for percent in self.resonance)} %"] if self.resonance else []
        return ", ".join(
            [*parts, f"damping × {self.damping:.3g}", f"gain {self.gain:+.3g} %", f"delay_ticks {self.delay_ticks}"]
        )


class Family:
    """A model, its lightly damped modes, and the plants around it; modes above half the rate of `period_s` stay.

    `modes` (n,) are the upper poles in rad/s, slowest first, `leading` the indices of the LEADING_COUNT highest peaks,
    `delays` all delays in samples, from `options`, or `delay_ticks` alone.
    """

    def __init__(self, model: Transfer, delay_ticks: int, options: ScenarioOptions, period_s: float):
        """Find the lightly damped modes of `model` below half the rate, and the leading ones: the highest peaks.

        `delay_ticks` is the delay in samples unless `options` list delays.
        """
        self.model, self.options, self.period_s = model, options, period_s
        self.modes = light_modes(model, period_s)
        peaks = np.abs(model.response(1j * np.abs(self.modes)))
        self.leading = tuple(sorted(np.argsort(-peaks, kind="stable")[:LEADING_COUNT].tolist()))
        self.delays = options.delay_ticks or (delay_ticks,)

    @property
    def bands(self) -> Real:
        """Least and largest |Im s| (rad/s) of closed-loop poles that belong to each leading mode, (leading modes, 2).

        MODE_BAND times the mode's |s|, as far as no other lightly damped mode is nearer.
        """
        sizes = np.abs(self.modes)
        between = np.concatenate([[0.0], np.sqrt(sizes[1:] * sizes[:-1]), [np.inf]])
        bands = np.column_stack([
            np.maximum(MODE_BAND[0] * sizes, between[:-1]), np.minimum(MODE_BAND[1] * sizes, between[1:])
        ])  # fmt: skip
        return bands[list(self.leading)]

    def plant(self, scenario: Scenario) -> Transfer:
        """Return the plant of a scenario, without its delay; a shifted frequency changes neither damping ratio nor
        D(0), which change by the scenario's own factors.
        """
        poles, gain = self.model.poles.copy(), self.model.gain * (1 + scenario.gain / 100)
        for mode, percent in zip(self.modes, scenario.resonance, strict=True):
            size, ratio = abs(mode) * (1 + percent / 100), -mode.real / abs(mode) * scenario.damping
            shifted = size * complex(-ratio, np.sqrt(max(1 - ratio**2, 0.0)))
            poles[self.model.poles == mode], poles[self.model.poles == np.conj(mode)] = shifted, np.conj(shifted)
            gain *= (size / abs(mode)) ** 2
        return Transfer(self.model.zeros, poles, gain)

    @property
    def nominal(self) -> Scenario:
        """Scenario of the unchanged model, at the first of `delays`."""
        return Scenario((0.0,) * self.modes.size, 1.0, 0.0, self.delays[0])

    def corner_scenarios(self) -> list[Scenario]:
        """Return the unchanged model, and for each delay every combination of the ends of resonance, damping and gain.

        Resonances in the middle are included, and resonances halfway to the ends with the least damping. Modes other
        than the LEADING_COUNT leading ones stay, or all modes move alike; `random_scenarios` moves each by its own
        shift.
        """
        r, g = self.options.resonance_percent, self.options.gain_percent
        ends = sorted({*self.options.damping})
        dampings = sorted({ends[0], ends[-1]})
        shifts = self._resonance_shifts(-r, 0.0, r)
        halfway = self._resonance_shifts(-r / 2, r / 2) if self.modes.size else []
        scenarios = [self.nominal]
        for ticks in self.delays:
            scenarios += [
                Scenario(*combination, ticks) for combination in itertools.product(shifts, dampings, sorted({-g, g}))
            ]  # fmt: skip
            scenarios += [Scenario(shift, ends[0], gain, ticks) for shift in halfway for gain in sorted({-g, g})]
        return list(dict.fromkeys(scenarios))

    def _resonance_shifts(self, *places: float) -> list[tuple[float, ...]]:
        """Return the shifts (modes,) of all modes in percent: every combination of `places` for the leading modes, the
        others unmoved, then all modes moved alike.
        """
        shifts = []
        for percents in itertools.product(sorted({*places}), repeat=len(self.leading)):
            shift = np.zeros(self.modes.size)
            shift[list(self.leading)] = percents
            shifts.append(tuple(shift.tolist()))
        return [*dict.fromkeys([*shifts, *((place,) * self.modes.size for place in sorted({*places}))])]

    def sweep_scenarios(self, count: int) -> Iterator[Scenario]:
        """Yield scenarios for every delay and each end of damping and gain: all lightly damped modes are moved
        together, by `count` evenly spaced shifts from −resonance_percent to +resonance_percent; by 0 alone without
        lightly damped modes or range.
        """
        r, g = self.options.resonance_percent, self.options.gain_percent
        places = np.linspace(-r, r, count) if self.modes.size and r else [0.0]
        damping = sorted({min(self.options.damping), max(self.options.damping)}) if self.modes.size else [1.0]
        for ticks, factor, gain in itertools.product(self.delays, damping, sorted({-g, g})):
            yield from (Scenario((float(place),) * self.modes.size, factor, gain, ticks) for place in places)

    def random_scenarios(self, count: int, seed: int) -> Iterator[Scenario]:
        """Yield `count` random scenarios: each mode's frequency and the gain uniform, the common factor on the damping
        uniform in its logarithm, one of the delays.
        """
        random, options = np.random.default_rng(seed), self.options
        r, g = options.resonance_percent, options.gain_percent
        low, high = np.log([min(options.damping), max(options.damping)])
        for _ in range(count):
            shift = tuple(float(value) for value in random.uniform(-r, r, self.modes.size))
            damping, gain = float(np.exp(random.uniform(low, high))), float(random.uniform(-g, g))
            yield Scenario(shift, damping, gain, int(random.choice(self.delays)))


def light_modes(model: Transfer, period_s: float) -> Complex:
    """Return poles (rad/s) of damping below LIGHT_DAMPING with 0 < Im s < π/`period_s`, slowest first."""
    upper = model.poles[(model.poles.imag > 0) & (model.poles.imag < np.pi / period_s)]
    light = upper[-upper.real < LIGHT_DAMPING * np.abs(upper)]
    return light[np.argsort(np.abs(light))]

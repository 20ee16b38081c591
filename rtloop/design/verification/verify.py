"""A controller judged: every specification with what is required, what is achieved and a verdict, and how robust it is.

Twice, and linear: in continuous time, C(s)·D(s), as it is designed, where there is a C(s); and as it will run, C(z)
with its pre-filter behind the hold and the delay, seen through the sensor. A controller that meets its specification on
paper only does not meet it, and neither does one that misses it in a scenario that is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from rtloop.analysis.closed_loop import Loop, continuous_loop
from rtloop.analysis.comparison import compare
from rtloop.analysis.coupled_loop import TogetherMargins
from rtloop.analysis.perturbation import Range, changes, maker, until_unstable
from rtloop.design.synthesis.hinf.augment import augmented
from rtloop.design.synthesis.specification import QUANTITIES, DesignOptions, weights_of
from rtloop.design.synthesis.synthesise import weighted_norm
from rtloop.design.synthesis.weights import Weights
from rtloop.design.verification.judgement import Limit, described, limits, specified
from rtloop.design.verification.robustness import (
    Plants,
    Worst,
    delay_margin_us,
    delay_ticks_tolerated,
    resonance_of,
    shift_tolerated,
    until_missed,
    worst_of,
)
from rtloop.design.verification.simulated import Simulated
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.transfer import Transfer
from rtloop.supervision.host_delay import SpentMargin

OF_STEPS = ("static_error_percent", "settling_ms", "overshoot_percent", "peak_command")
"""Quantities that depend on what the reference passes; the others are the feedback's alone."""
DELAYS = (0, 1, 2)
"""Samples of delay for which the tolerated shift of the resonance is always shown."""


class Row(NamedTuple):
    """One quantity; None where it is not defined in that time. `claim` is what the controller's source says."""

    name: str
    limit: Limit | None
    continuous: float | None
    running: float | None
    claim: str

    @property
    def label(self) -> str:
        """For people."""
        return QUANTITIES[self.name][0]

    @property
    def unit(self) -> str:
        """As it is printed."""
        return QUANTITIES[self.name][1]

    def met(self, value: float | None) -> bool | None:
        """The verdict, None where nothing is required or nothing known."""
        return None if self.limit is None or value is None else self.limit.met(value)


class Subject(NamedTuple):
    """What is judged: the loop as it runs, by dynamics and samples of delay, and C(s) where there is one, with C(z)."""

    running: Callable[[Transfer, int], Loop]
    controller: Transfer | None = None
    discrete: DiscreteController | None = None


class Robustness(NamedTuple):
    """Percent by which each of `ranges` may move until unstable, and, as it runs, until what is met now is missed.

    `shifts` is that of the resonance, by kind of time; delays are what may come on top.
    """

    ranges: dict[str, dict[str, Range | None]]
    shifts: dict[str, Range]
    delay_us: float
    delay_ticks: int


@dataclass(frozen=True)
class Scenarios:
    """The worst of so many plants, row for row of those quantities that a specification is about."""

    count: int
    rows: tuple[tuple[Row, Worst], ...]

    def met(self, row: Row, worst: Worst) -> bool | None:
        """The verdict: of a step's figures, which taps that fit the plant would mend, only that they exist."""
        return None if row.name in OF_STEPS and not math.isnan(worst.value) else row.met(worst.value)

    @property
    def missed(self) -> list[tuple[Row, Worst]]:
        """The required ones that some plant misses."""
        return [(row, worst) for row, worst in self.rows if self.met(row, worst) is False]


@dataclass(frozen=True, eq=False)
class Verification:
    """Everything found out about one axis. `weights` is None where the specification gives none."""

    rows: tuple[Row, ...]
    examine: Callable[[], Robustness]
    warnings: tuple[str, ...]
    continuous: Loop | None
    running: Loop
    delay_ticks: int
    weights: Weights | None
    gamma: float | None
    together: TogetherMargins | None = None
    scenarios: Scenarios | None = None
    simulated: Simulated | None = None
    host: SpentMargin | None = None

    @cached_property
    def robustness(self) -> Robustness:
        """How far what may move may move; most of the time that a verification takes."""
        return self.examine()

    @property
    def slowest_s(self) -> float:
        """Time constant of the slowest mode as it runs."""
        return float(-1 / self.running.rates.real.max(initial=-math.inf))

    @property
    def missed(self) -> list[Row]:
        """The required rows that the loop misses as it will run."""
        return [row for row in self.rows if row.met(row.running) is False]

    @property
    def meets(self) -> bool:
        """Stable as it will run, and on this host as far as it was measured, with every requirement met, in every
        scenario and simulation that is judged, too."""
        scenarios_hold = self.scenarios is None or not self.scenarios.missed
        simulation_holds = self.simulated is None or not self.simulated.missed
        host_holds = self.host is None or not self.host.is_spent
        return self.running.is_stable and not self.missed and scenarios_hold and simulation_holds and host_holds


def verify(
    subject: Subject,
    plant: Transfer,
    design: DesignOptions,
    delay_ticks: int = 0,
    together: TogetherMargins | None = None,
    plants: Plants = (),
) -> Verification:
    """Judge a loop on a plant, behind `delay_ticks` samples; `together` is what its axis shares with others.

    `plants` are others on which it must keep its specification as well.
    Raises ValueError for a plant with direct feedthrough.
    """
    specification, sensed_plant, controller = (
        design.specification,
        design.sensor.seen_through(plant),
        subject.controller,
    )
    continuous = None if controller is None else continuous_loop(controller, plant)
    running = subject.running(sensed_plant, delay_ticks)
    weights = None if controller is None else _weights(design)
    gamma = None
    if weights is not None and controller is not None:
        gamma = weighted_norm(augmented(plant, weights), controller)
    resonance = resonance_of(plant)
    columns = [
        {} if loop is None else specified(loop, specification, resonance) | described(loop, design.sensor)
        for loop in (continuous, running)
    ]
    if specification.resonance_shift_percent is not None:
        columns[1]["resonance_shift_percent"] = shift_tolerated(
            lambda changed_plant: subject.running(changed_plant, delay_ticks), sensed_plant
        )
    if gamma is not None:
        columns[0]["gamma"] = gamma
    required = limits(specification)
    rows = tuple(
        Row(name, required.get(name), columns[0].get(name), columns[1].get(name), specification.claimed(name))
        for name in QUANTITIES
        if any(name in column for column in columns)
    )
    scenarios = None
    if plants:
        sensed_plants = [(name, design.sensor.seen_through(dynamics), ticks) for name, dynamics, ticks in plants]
        worst_by_name = worst_of(subject.running, sensed_plants, specification, resonance)
        scenarios = Scenarios(
            len(plants), tuple((row, worst_by_name[row.name]) for row in rows if row.name in worst_by_name)
        )
    warnings: tuple[str, ...] = ()
    if controller is not None and subject.discrete is not None:
        warnings = tuple(compare(controller, subject.discrete, up_to_hz=0.2 / subject.discrete.period_s).warnings)
    return Verification(
        rows, lambda: _robustness(subject, plant, sensed_plant, design, delay_ticks, rows), warnings,
        continuous, running, delay_ticks, weights, gamma, together, scenarios,
    )  # fmt: skip


def _weights(design: DesignOptions) -> Weights | None:
    try:
        return weights_of(design)
    except ValueError:
        return None


def _robustness(
    subject: Subject,
    plant: Transfer,
    sensed: Transfer,
    design: DesignOptions,
    delay_ticks: int,
    rows: tuple[Row, ...],
) -> Robustness:
    make_continuous = None if subject.controller is None else maker(subject.controller)

    def runs(moved: Transfer) -> Loop:
        return subject.running(moved, delay_ticks)

    loop_rows = [row for row in rows if row.name != "resonance_shift_percent"]
    met_limits = {row.name: row.limit for row in loop_rows if row.limit is not None and row.met(row.running)}
    ranges: dict[str, dict[str, Range | None]] = {}
    shifts: dict[str, Range] = {}
    for name, change in changes(plant).items():
        continuous_range = (
            {} if make_continuous is None else {"continuous": until_unstable(make_continuous, plant, change)}
        )
        ranges[name] = {
            **continuous_range,
            "running": until_unstable(runs, sensed, change),
            "running_missed": until_missed(runs, sensed, change, design.specification, met_limits)
            if met_limits
            else None,
        }
        if name == "resonance":
            delayed_ranges = {
                str(ticks): until_unstable(lambda moved, ticks=ticks: subject.running(moved, ticks), sensed, change)
                for ticks in DELAYS
            }
            shifts = {**continuous_range, **delayed_ranges}
    extra_ticks = delay_ticks_tolerated(lambda ticks: subject.running(sensed, ticks)) - delay_ticks
    loop = runs(sensed) if make_continuous is None else make_continuous(plant)
    return Robustness(ranges, shifts, delay_margin_us(loop), extra_ticks)

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
from rtloop.analysis.comparison import compare_controllers
from rtloop.analysis.coupled_loop import SimultaneousMargins
from rtloop.analysis.perturbation import PercentRange, loop_builder, plant_changes, stability_range
from rtloop.design.synthesis.hinf.augment import augment
from rtloop.design.synthesis.specification import QUANTITIES, DesignOptions, build_weights
from rtloop.design.synthesis.synthesise import weighted_norm
from rtloop.design.synthesis.weights import Weights
from rtloop.design.verification.judgement import Limit, loop_quantities, required_limits, specified_quantities
from rtloop.design.verification.robustness import (
    Plants,
    WorstValue,
    delay_margin_us,
    range_until_missed,
    resonance_frequency,
    tolerated_delay_ticks,
    tolerated_shift,
    worst_values,
)
from rtloop.design.verification.simulated import SimulationResult
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.transfer import Transfer
from rtloop.supervision.host_delay import SpentMargin

STEP_QUANTITIES = ("static_error_percent", "settling_ms", "overshoot_percent", "peak_command")
"""Quantities that depend on what the reference passes; the others are the feedback's alone."""
SHOWN_DELAYS = (0, 1, 2)
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

    def is_met(self, value: float | None) -> bool | None:
        """The verdict, None where nothing is required or nothing known."""
        return None if self.limit is None or value is None else self.limit.is_met_by(value)


class VerifiedLoop(NamedTuple):
    """What is judged: the loop as it runs, by dynamics and samples of delay, and C(s) where there is one, with C(z)."""

    running: Callable[[Transfer, int], Loop]
    controller: Transfer | None = None
    discrete: DiscreteController | None = None


class Robustness(NamedTuple):
    """Percent by which each of `ranges` may move until unstable, and, as it runs, until what is met now is missed.

    `shifts` is that of the resonance, by kind of time; delays are what may come on top.
    """

    ranges: dict[str, dict[str, PercentRange | None]]
    shifts: dict[str, PercentRange]
    delay_us: float
    delay_ticks: int


@dataclass(frozen=True)
class ScenarioResults:
    """The worst of so many plants, row for row of those quantities that a specification is about."""

    count: int
    rows: tuple[tuple[Row, WorstValue], ...]

    def is_met(self, row: Row, worst: WorstValue) -> bool | None:
        """The verdict: of a step's figures, which taps that fit the plant would mend, only that they exist."""
        return None if row.name in STEP_QUANTITIES and not math.isnan(worst.value) else row.is_met(worst.value)

    @property
    def missed(self) -> list[tuple[Row, WorstValue]]:
        """The required ones that some plant misses."""
        return [(row, worst) for row, worst in self.rows if self.is_met(row, worst) is False]


@dataclass(frozen=True, eq=False)
class Verification:
    """Everything found out about one axis. `weights` is None where the specification gives none."""

    rows: tuple[Row, ...]
    find_robustness: Callable[[], Robustness]
    warnings: tuple[str, ...]
    continuous: Loop | None
    running: Loop
    delay_ticks: int
    weights: Weights | None
    gamma: float | None
    together: SimultaneousMargins | None = None
    scenarios: ScenarioResults | None = None
    simulated: SimulationResult | None = None
    host: SpentMargin | None = None

    @cached_property
    def robustness(self) -> Robustness:
        """How far what may move may move; most of the time that a verification takes."""
        return self.find_robustness()

    @property
    def slowest_s(self) -> float:
        """Time constant of the slowest mode as it runs."""
        return float(-1 / self.running.rates.real.max(initial=-math.inf))

    @property
    def missed_rows(self) -> list[Row]:
        """The required rows that the loop misses as it will run."""
        return [row for row in self.rows if row.is_met(row.running) is False]

    @property
    def meets_specification(self) -> bool:
        """Stable as it will run, and on this host as far as it was measured, with every requirement met, in every
        scenario and simulation that is judged, too."""
        scenarios_hold = self.scenarios is None or not self.scenarios.missed
        simulation_holds = self.simulated is None or not self.simulated.missed
        host_holds = self.host is None or not self.host.is_spent
        return self.running.is_stable and not self.missed_rows and scenarios_hold and simulation_holds and host_holds


def verify(
    subject: VerifiedLoop,
    plant: Transfer,
    design: DesignOptions,
    delay_ticks: int = 0,
    together: SimultaneousMargins | None = None,
    plants: Plants = (),
) -> Verification:
    """Judge a loop on a plant, behind `delay_ticks` samples; `together` is what its axis shares with others.

    `plants` are others on which it must keep its specification as well.
    Raises ValueError for a plant with direct feedthrough.
    """
    specification, sensed_plant, controller = (
        design.specification,
        design.sensor.add_sensor_lag(plant),
        subject.controller,
    )
    continuous = None if controller is None else continuous_loop(controller, plant)
    running = subject.running(sensed_plant, delay_ticks)
    weights = None if controller is None else _weights(design)
    gamma = None
    if weights is not None and controller is not None:
        gamma = weighted_norm(augment(plant, weights), controller)
    resonance = resonance_frequency(plant)
    columns = [
        {}
        if loop is None
        else specified_quantities(loop, specification, resonance) | loop_quantities(loop, design.sensor)
        for loop in (continuous, running)
    ]
    if specification.resonance_shift_percent is not None:
        columns[1]["resonance_shift_percent"] = tolerated_shift(
            lambda changed_plant: subject.running(changed_plant, delay_ticks), sensed_plant
        )
    if gamma is not None:
        columns[0]["gamma"] = gamma
    required = required_limits(specification)
    rows = tuple(
        Row(name, required.get(name), columns[0].get(name), columns[1].get(name), specification.claim_words(name))
        for name in QUANTITIES
        if any(name in column for column in columns)
    )
    scenarios = None
    if plants:
        sensed_plants = [(name, design.sensor.add_sensor_lag(dynamics), ticks) for name, dynamics, ticks in plants]
        worst_by_name = worst_values(subject.running, sensed_plants, specification, resonance)
        scenarios = ScenarioResults(
            len(plants), tuple((row, worst_by_name[row.name]) for row in rows if row.name in worst_by_name)
        )
    warnings: tuple[str, ...] = ()
    if controller is not None and subject.discrete is not None:
        warnings = tuple(
            compare_controllers(controller, subject.discrete, up_to_hz=0.2 / subject.discrete.period_s).warnings
        )
    return Verification(
        rows, lambda: _robustness(subject, plant, sensed_plant, design, delay_ticks, rows), warnings,
        continuous, running, delay_ticks, weights, gamma, together, scenarios,
    )  # fmt: skip


def _weights(design: DesignOptions) -> Weights | None:
    try:
        return build_weights(design)
    except ValueError:
        return None


def _robustness(
    subject: VerifiedLoop,
    plant: Transfer,
    sensed_plant: Transfer,
    design: DesignOptions,
    delay_ticks: int,
    rows: tuple[Row, ...],
) -> Robustness:
    make_continuous = None if subject.controller is None else loop_builder(subject.controller)

    def runs(changed_plant: Transfer) -> Loop:
        return subject.running(changed_plant, delay_ticks)

    loop_rows = [row for row in rows if row.name != "resonance_shift_percent"]
    met_limits = {row.name: row.limit for row in loop_rows if row.limit is not None and row.is_met(row.running)}
    ranges: dict[str, dict[str, PercentRange | None]] = {}
    shifts: dict[str, PercentRange] = {}
    for name, change in plant_changes(plant).items():
        continuous_range = (
            {} if make_continuous is None else {"continuous": stability_range(make_continuous, plant, change)}
        )
        ranges[name] = {
            **continuous_range,
            "running": stability_range(runs, sensed_plant, change),
            "running_missed": range_until_missed(runs, sensed_plant, change, design.specification, met_limits)
            if met_limits
            else None,
        }
        if name == "resonance":
            delayed_ranges = {
                str(ticks): stability_range(
                    lambda moved, ticks=ticks: subject.running(moved, ticks), sensed_plant, change
                )
                for ticks in SHOWN_DELAYS
            }
            shifts = {**continuous_range, **delayed_ranges}
    extra_ticks = tolerated_delay_ticks(lambda ticks: subject.running(sensed_plant, ticks)) - delay_ticks
    loop = runs(sensed_plant) if make_continuous is None else make_continuous(plant)
    return Robustness(ranges, shifts, delay_margin_us(loop), extra_ticks)

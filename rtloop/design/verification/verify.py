"""Verification of a controller: required value, achieved value and verdict of each specification, and robustness.

The linear loop is judged twice: in continuous time, C(s)·D(s), if there is a C(s); and sampled, C(z) with prefilter,
hold, delay and sensor. Only the sampled loop decides the verdict, together with the requested scenarios.
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
from rtloop.design.synthesis.hinf.norm import weighted_norm
from rtloop.design.synthesis.specification import QUANTITIES, DesignOptions, build_weights
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
from rtloop.design.verification.simulated_steps import SimulationResult
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.transfer import Transfer
from rtloop.supervision.host_delay import SpentMargin

STEP_QUANTITIES = ("static_error_percent", "settling_ms", "overshoot_percent", "peak_command")
"""Quantities that depend on the reference path; all others depend on the feedback alone."""
SHOWN_DELAYS = (0, 1, 2)
"""Delays in samples for which the tolerated shift of the resonance is always listed."""


class Row(NamedTuple):
    """Values of a quantity for the continuous and the running loop, None where the loop has no such value; `claim`
    quotes the controller's source.
    """

    name: str
    limit: Limit | None
    continuous: float | None
    running: float | None
    claim: str

    @property
    def label(self) -> str:
        """Printed label of the quantity."""
        return QUANTITIES[self.name][0]

    @property
    def unit(self) -> str:
        """Printed unit of the quantity."""
        return QUANTITIES[self.name][1]

    def is_met(self, value: float | None) -> bool | None:
        """Whether `value` meets the limit, as NaN never does; None without limit or value."""
        return None if self.limit is None or value is None else self.limit.accepts(value)


class VerifiedLoop(NamedTuple):
    """Loop to verify: builder of the running loop from dynamics and delay in samples; C(s) and C(z) if they exist."""

    running: Callable[[Transfer, int], Loop]
    controller: Transfer | None = None
    discrete: DiscreteController | None = None


class Robustness(NamedTuple):
    """Tolerated changes in percent, until the loop is unstable and until a requirement met now is missed.

    Both ends of a range, `down` and `up`, are ≥ 0, or None if the search found no failure there.

    `ranges` maps a plant parameter to "continuous", "running" and "running_missed" (None if no limit is met); `shifts`
    is the tolerated shift of the resonance, by "continuous" or samples of delay. "continuous" exists with C(s) only.
    `delay_us` is the additional delay that the loop of C(s) tolerates, or without C(s) the running loop; `delay_ticks`
    the additional samples that the running loop tolerates, below 0 for an unstable one, None where the search found no
    end.
    """

    ranges: dict[str, dict[str, PercentRange | None]]
    shifts: dict[str, PercentRange]
    delay_us: float
    delay_ticks: int | None


@dataclass(frozen=True)
class ScenarioResults:
    """Worst values over `count` plants, with the row of each specified quantity."""

    count: int
    rows: tuple[tuple[Row, WorstValue], ...]

    def is_met(self, row: Row, worst_value: WorstValue) -> bool | None:
        """Whether `worst_value` meets the row's limit.

        None for one of STEP_QUANTITIES, which taps that fit the plant would correct, unless it is NaN, and without a
        limit.
        """
        return (
            None if row.name in STEP_QUANTITIES and not math.isnan(worst_value.value) else row.is_met(worst_value.value)
        )

    @property
    def missed_rows(self) -> list[tuple[Row, WorstValue]]:
        """Required rows that at least one plant misses, with their worst value."""
        return [entry for entry in self.rows if self.is_met(*entry) is False]


@dataclass(frozen=True, eq=False)
class Verification:
    """All results for one axis.

    `weights`, and `gamma`, the H∞ norm of the loop with these weights, are None without C(s) and where the
    specification defines no weights. `contradictions` has a line for each key that makes the loop differ from the
    verified one. `on_rig` judges the loop on the simulated rig. It is None for drivers other than a simulated rig, for
    an axis without a linear loop on its own model, and without a contradiction if the loop is stable on the rig.
    """

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
    contradictions: tuple[str, ...] = ()
    on_rig: Verification | None = None

    @cached_property
    def robustness(self) -> Robustness:
        """Tolerated changes; computed and stored on first use, which takes most of the time of a verification."""
        return self.find_robustness()

    @property
    def slowest_s(self) -> float:
        """1/|Re s| in s of the slowest mode of the running loop; negative for an unstable loop."""
        return float(-1 / self.running.rates.real.max(initial=-math.inf))

    @property
    def missed_rows(self) -> list[Row]:
        """Required rows that the running loop misses."""
        return [row for row in self.rows if row.is_met(row.running) is False]

    @property
    def meets_specification(self) -> bool:
        """Whether the running loop is stable and meets all requirements, also in the scenarios and simulated steps
        that are judged, and within the delay margin of this host if it was measured.

        A loop judged on the simulated rig (`on_rig`) must meet them there too; contradictions without it give False.
        """
        scenarios_hold = self.scenarios is None or not self.scenarios.missed_rows
        simulation_holds = self.simulated is None or not self.simulated.violations
        host_holds = self.host is None or not self.host.is_spent
        rig_holds = not self.contradictions if self.on_rig is None else self.on_rig.meets_specification
        loop_holds = self.running.is_stable and not self.missed_rows
        return loop_holds and scenarios_hold and simulation_holds and host_holds and rig_holds


def verify(
    subject: VerifiedLoop,
    plant: Transfer,
    design: DesignOptions,
    delay_ticks: int = 0,
    together: SimultaneousMargins | None = None,
    plants: Plants = (),
) -> Verification:
    """Verify a loop on a plant behind `delay_ticks` samples. Raises ValueError for a plant with direct feedthrough.

    `together` holds the margins of all axes of a coupled controller; `plants` are further plants on which the loop must
    meet its specification, except for STEP_QUANTITIES. Robustness is computed on first use.
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
    if running.reference_fault:
        columns[1] = {name: value for name, value in columns[1].items() if name not in STEP_QUANTITIES}
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
    """Return the weights of `design`; None if `build_weights` raises ValueError."""
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
    """Return the tolerated changes of the plant and the tolerated additional delay.

    `sensed_plant` is `plant` with the sensor's lag. `rows` have the values that the loop reaches now: requirements that
    it misses do not limit the ranges.
    """
    make_continuous = None if subject.controller is None else loop_builder(subject.controller)

    def runs(changed_plant: Transfer) -> Loop:
        """Return the running loop on a changed plant, at the present delay."""
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
    most_ticks = tolerated_delay_ticks(lambda ticks: subject.running(sensed_plant, ticks))
    extra_ticks = None if most_ticks is None else most_ticks - delay_ticks
    loop = runs(sensed_plant) if make_continuous is None else make_continuous(plant)
    return Robustness(ranges, shifts, delay_margin_us(loop), extra_ticks)

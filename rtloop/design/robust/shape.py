"""Reference and feedforward taps for the fastest step that loop, taps and drive allow in every scenario (bisection)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rtloop.design.robust.options import ShapeOptions
from rtloop.design.robust.programme import BAND, USED_SHARE, Bounds, Programme, Taps
from rtloop.design.robust.responses import Responses, horizon_ticks, step_responses
from rtloop.design.robust.scenarios import Family, Scenario
from rtloop.errors import NoDesign
from rtloop.foundation.arrays import Real
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.sampled import SampledController
from rtloop.linear.transfer import Transfer

SWEEP_PLACES, PROOF_PLACES, MOST_ROUNDS = 7, 41, 6
"""Resonance frequencies sampled for a programme, and for the proof of its result; most rounds of adding worst
scenarios.
"""
PROOF_POINTS = 10
"""Points per tick at which a proof computes the position."""
ALLOWED_EXCESS = 1e-4
"""Largest excess of v over its limits in a proof, per unit step: 4 nm of 40 µm."""
LONGEST_SHARE = 0.9
"""Longest settling time searched, as a fraction of the taps' length."""
CURVE_RANGE = (0.93, 1.15, 23)
"""Settling times of the trade-off curve: from, to (relative to the fastest), number of points."""


@dataclass(frozen=True)
class Subject:
    """Loop for which taps are designed, with bounds, options and the largest `overshoot` (a fraction)."""

    controller: DiscreteController | SampledController
    plant: Transfer
    delay_ticks: int
    bounds: Bounds
    overshoot: float
    options: ShapeOptions

    def restrict_resonance(self, percent: float, gain_percent: float = 0.0) -> Subject:
        """Return a copy whose scenarios vary the resonance frequency by ±`percent` of the model's, and the gain by
        ±`gain_percent`. They keep the delays of the present scenarios, and do not vary the damping.
        """
        varied = {"resonance_percent": percent, "damping": (1.0,), "gain_percent": gain_percent}
        scenarios = self.options.scenarios.model_copy(update=varied)
        return replace(self, options=self.options.model_copy(update={"scenarios": scenarios}))

    def family(self) -> Family:
        """Return the family of plants around the model, for the scenarios of `options`."""
        return Family(self.plant, self.delay_ticks, self.options.scenarios, self.controller.period_s)


class StepMeasures(NamedTuple):
    """Figures of a unit step: settling to ±5 % (ms), overshoot (fraction), excess of v over its limits per unit step
    (negative inside), undershoot (fraction), least and largest v per unit step.
    """

    settling_ms: float
    overshoot: float
    excess: float
    undershoot: float
    lowest_command: float
    highest_command: float


class TapDesign(NamedTuple):
    """Taps that settle in `settling_ms`; `fastest_ms` is the least possible.

    `proof` holds the worst figures of `proved_count` plants at PROOF_POINTS points a tick; `step` is the model's step
    (t in s, x, v), `variation` the total variation of its v; `curve` has points (settling time in ms, least overshoot)
    of the trade-off, () without `curve=True`.
    """

    taps: Taps
    settling_ms: float
    fastest_ms: float
    variation: float
    proof: StepMeasures
    proved_count: int
    step: tuple[Real, Real, Real]
    curve: tuple[tuple[float, float], ...]


def design_taps(
    subject: Subject,
    *,
    curve: bool = False,
    progress: Callable[[str], None] = lambda _: None,
    may_be_late: bool = False,
) -> TapDesign:
    """Design the taps of reference and feedforward for the loop of `subject`.

    The taps settle fastest, or in `subject.options.settling_ms` if set; of these the ones with the least variation of
    the command v. They are designed for some plants of the family, and proved by a simulated step on many; a further
    round adds the worst plants of a failed proof. `curve` adds the trade-off of settling time and overshoot, `progress`
    receives a sentence per round. `may_be_late`: if `settling_ms` cannot be reached, return the fastest taps instead of
    raising. Raises NoDesign, with possible relaxations, if no taps exist; NoDesign also if the proof fails MOST_ROUNDS
    times, if the loop of a plant is unstable, and if no solver finishes.
    """
    options, tick_ms, family = subject.options, 1e3 * subject.controller.period_s, subject.family()
    scenarios = list(dict.fromkeys([family.nominal, *family.sweep_scenarios(SWEEP_PLACES)]))
    fastest, rounds, allowed_overshoot = 0.0, 0, subject.overshoot
    while True:
        rounds += 1
        programme = build_programme(subject, scenarios)
        fastest = fastest_settling(programme, allowed_overshoot, fastest)
        if fastest is None:
            raise NoDesign(_explain_no_taps(subject, programme))
        progress(
            f"{len(scenarios)} scenarios: fastest settling {fastest * tick_ms:.4g} ms, overshoot ≤ "
            f"{100 * subject.overshoot:g} %"
        )
        settling = fastest if options.settling_ms is None else options.settling_ms / tick_ms
        if may_be_late:
            settling = max(settling, fastest)
        if settling < fastest - 1e-9:
            raise NoDesign(
                f"shape.settling_ms: {options.settling_ms:g} ms cannot be reached in all scenarios with overshoot ≤ "
                f"{100 * subject.overshoot:g} %; the fastest settling time is {fastest * tick_ms:.4g} ms. "
                f"{_describe_relaxations(subject)}"
            )
        taps = programme.quietest_taps(settling, allowed_overshoot)
        if taps is None:
            raise NoDesign(
                f"shape: settling in {settling * tick_ms:.4g} ms is too close to the fastest possible, "
                f"{fastest * tick_ms:.4g} ms; use a longer shape.settling_ms"
            )
        measures = {
            scenario: measure_step(subject, taps, scenario)
            for scenario in dict.fromkeys([*scenarios, *family.sweep_scenarios(PROOF_PLACES)])
        }
        worst_scenarios = [max(measures, key=lambda scenario, i=i: measures[scenario][i]) for i in range(3)]
        new_scenarios = [scenario for scenario in dict.fromkeys(worst_scenarios) if scenario not in scenarios]
        proof = _worst_measures(measures.values())
        is_settled = proof.settling_ms <= (settling + 1 / options.points_per_tick) * tick_ms
        if is_settled and proof.overshoot <= subject.overshoot and proof.excess <= ALLOWED_EXCESS:
            break
        if rounds == MOST_ROUNDS:
            raise NoDesign(_proof_failure(subject, settling * tick_ms, proof, len(measures)))
        scenarios += new_scenarios
        if proof.overshoot > subject.overshoot:
            allowed_overshoot *= USED_SHARE * subject.overshoot / proof.overshoot
    time, position, command = _simulate_step(subject, taps, family.nominal)
    curve_points = trade_off_curve(programme, fastest, tick_ms) if curve else ()
    variation = float(np.sum(np.abs(np.diff(command, prepend=0.0))))
    return TapDesign(
        taps,
        settling * tick_ms,
        fastest * tick_ms,
        variation,
        proof,
        len(measures),
        (time, position, command),
        curve_points,
    )


def build_programme(subject: Subject, scenarios: list[Scenario]) -> Programme:
    """Return the linear programme over `scenarios`, the model first. Raises NoDesign if a loop is unstable."""
    family, options = subject.family(), subject.options
    ticks = horizon_ticks(subject.controller, family, scenarios, options.taps)
    scenario_responses = [
        _scenario_responses(subject, family, scenario, options.points_per_tick, ticks) for scenario in scenarios
    ]
    return Programme(
        scenario_responses, options.taps, options.points_per_tick, subject.bounds, options.band_percent / 100
    )


def fastest_settling(programme: Programme, overshoot: float, least_ticks: float = 0.0) -> float | None:
    """Return the least settling time in ticks, at least `least_ticks`, at which taps with `overshoot` (a fraction, see
    `Programme.is_feasible`) exist; resolution 1/points of a tick.

    None if LONGEST_SHARE of the taps' length does not suffice. Raises NoDesign if no solver finishes.
    """

    def is_feasible(point: int) -> bool:
        """Whether taps settle within `point` points, each 1/points of a tick."""
        return programme.is_feasible(point / programme.points, overshoot)

    low, longest, step = (
        round(least_ticks * programme.points),
        int(LONGEST_SHARE * programme.taps) * programme.points,
        2,
    )
    if low and is_feasible(low):
        return low / programme.points
    high = low + step if low else longest
    while not is_feasible(high):
        if high >= longest:
            return None
        low, step = high, 2 * step
        high = min(low + step, longest)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_feasible(middle) else (middle, high)
    return high / programme.points


def trade_off_curve(programme: Programme, fastest: float, tick_ms: float) -> tuple[tuple[float, float], ...]:
    """Return points (settling time in ms, least overshoot as a fraction), by rising time, for settling times around
    `fastest` ticks (CURVE_RANGE); infeasible times are omitted. Raises NoDesign if no solver finishes.
    """
    points: list[tuple[float, float]] = []
    for place in np.unique(np.round(np.linspace(*CURVE_RANGE) * fastest * programme.points)):
        taps = programme.least_overshoot_taps(place / programme.points)
        if taps is not None:
            points.append((float(place) / programme.points * tick_ms, taps.overshoot))
    return tuple(points)


def _worst_measures(all_measures: Iterable[StepMeasures]) -> StepMeasures:
    """Return the worst value of each figure: the largest, but the least for `lowest_command`."""
    settling, overshoot, excess, undershoot, low, high = (
        np.array(values) for values in zip(*all_measures, strict=True)
    )
    largest = (float(column.max()) for column in (settling, overshoot, excess, undershoot))
    return StepMeasures(*largest, lowest_command=float(low.min()), highest_command=float(high.max()))


def measure_step(subject: Subject, taps: Taps, scenario: Scenario) -> StepMeasures:
    """Simulate a unit step on the plant of `scenario` and return its figures. Raises NoDesign if the loop is unstable.

    The settling time is the simulation's end if the step never stays within ±5 %.
    """
    time, position, command = _simulate_step(subject, taps, scenario)
    low, high = subject.bounds.command_limits(np.array(1 / subject.family().plant(scenario).dc_gain))
    excess = float(max(command.max() - high, low - command.min()))
    unsettled = np.flatnonzero(np.abs(position - 1) > BAND)
    settled_s = float(time[min(unsettled[-1] + 1, time.size - 1)]) if unsettled.size else 0.0
    overshoot, undershoot = max(0.0, float(position.max()) - 1), max(0.0, -float(position.min()))
    return StepMeasures(1e3 * settled_s, overshoot, excess, undershoot, float(command.min()), float(command.max()))


def _simulate_step(subject: Subject, taps: Taps, scenario: Scenario) -> tuple[Real, Real, Real]:
    """Return times in s, x at these times (PROOF_POINTS a tick), and v at the ticks after a unit step.

    Raises NoDesign if the loop is unstable.
    """
    family, count = subject.family(), taps.reference.size
    ticks = horizon_ticks(subject.controller, family, [scenario], count)
    loop_responses = _scenario_responses(subject, family, scenario, PROOF_POINTS, ticks)
    position: Real = np.zeros(ticks * PROOF_POINTS)
    command: Real = np.zeros(ticks)
    for part, row in enumerate((taps.reference, taps.command)):
        spread = np.zeros((count - 1) * PROOF_POINTS + 1)
        spread[::PROOF_POINTS] = row
        position = position + np.convolve(spread, loop_responses.position[part])[: position.size].real
        command = command + np.convolve(row, loop_responses.command[part])[: command.size].real
    time = np.arange(1, position.size + 1) / PROOF_POINTS * subject.controller.period_s
    return time, position, command


def _scenario_responses(subject: Subject, family: Family, scenario: Scenario, points: int, ticks: int) -> Responses:
    """Return the responses of the loop of one scenario over `ticks` ticks, with `points` positions a tick.

    Raises NoDesign if the loop is unstable.
    """
    try:
        return step_responses(subject.controller, family.plant(scenario), scenario.delay_ticks, points, ticks)
    except ValueError as error:
        raise NoDesign(f"shape.scenarios: with {scenario}, {error}; use a more robust controller") from None


def _explain_no_taps(subject: Subject, programme: Programme) -> str:
    """Return the reason why no settling time is feasible, and remedies, as text."""
    longest = int(LONGEST_SHARE * programme.taps)
    tick_ms, best_taps = 1e3 * subject.controller.period_s, programme.least_overshoot_taps(longest)
    if best_taps is not None:
        return (
            f"specification.overshoot_percent: {100 * subject.overshoot:g} % cannot be kept in all scenarios with "
            f"{programme.taps} taps; the least overshoot is {100 * best_taps.overshoot:.4g} %, with a settling time of "
            f"{longest * tick_ms:g} ms. Allow more overshoot, or use smaller [shape.scenarios] or more shape.taps"
        )
    return (
        f"shape: no taps settle within {longest * tick_ms:g} ms, the longest settling time possible with shape.taps = "
        f"{programme.taps} at {1e3 / tick_ms:g} Hz. {_describe_relaxations(subject)}"
    )


def _proof_failure(subject: Subject, settling_ms: float, proof: StepMeasures, plants: int) -> str:
    """Return the message that taps, designed to settle in `settling_ms`, failed a proof that tried `plants` plants.

    It states the largest settling time and overshoot of `proof`, how far the command exceeds its limits, and a remedy.
    """
    is_beyond = proof.excess > ALLOWED_EXCESS
    excess_text = f"exceeds its limits by {100 * proof.excess:.2g} % of the height of the step"
    excess = excess_text if is_beyond else "stays within its limits"
    return (
        f"shape: the taps for a settling time of {settling_ms:.4g} ms and overshoot ≤ {100 * subject.overshoot:g} % "
        f"fail the proof on {plants} plants: the settling time is up to {proof.settling_ms:.4g} ms, the overshoot up "
        f"to {100 * proof.overshoot:.4g} %, and the command v {excess}. Use a longer shape.settling_ms or smaller "
        "[shape.scenarios]"
    )


def _describe_relaxations(subject: Subject) -> str:
    """Return as text the fastest settling in ms for each constraint relaxed alone, and the most helpful one.

    Each of these is relaxed alone: limits on v (none), undershoot (none), largest step (half of it), overshoot (BAND),
    scenarios (no variation of the plant). The fastest settling of each is searched anew, on few scenarios.
    """
    options, bounds, tick_ms = subject.options, subject.bounds, 1e3 * subject.controller.period_s
    far = 1e3 * max(abs(bounds.low_um), abs(bounds.high_um))
    nominal = options.scenarios.model_copy(update={"resonance_percent": 0.0, "damping": (1.0,), "gain_percent": 0.0})
    lowest_um = bounds.lowest_um / 2 if bounds.lowest_um <= 0 else bounds.lowest_um + bounds.step_um / 4
    half = bounds._replace(step_um=bounds.step_um / 2, lowest_um=lowest_um)
    variants = {
        f"specification.command.reference_um = {half.step_um:g} instead of {bounds.step_um:g}": replace(
            subject, bounds=half
        ),
        "no limit on v": replace(subject, bounds=bounds._replace(low_um=-far, high_um=far)),
        "any undershoot": replace(subject, bounds=bounds._replace(undershoot=far)),
        f"overshoot of {100 * BAND:g} %": replace(subject, overshoot=BAND),
        "no variation in [shape.scenarios]": replace(
            subject, options=options.model_copy(update={"scenarios": nominal})
        ),
    }  # fmt: skip
    fastest = dict[str, float | None]()
    for name, subject_variant in variants.items():
        family = subject_variant.family()
        scenarios = list(dict.fromkeys([family.nominal, *family.sweep_scenarios(3)]))
        fastest[name] = fastest_settling(build_programme(subject_variant, scenarios), subject_variant.overshoot)
    listed = ", ".join(
        f"{name} gives {'no settling' if value is None else f'{value * tick_ms:.4g} ms'}"
        for name, value in fastest.items()
    )
    best_relaxation = min(fastest, key=lambda name: math.inf if (value := fastest[name]) is None else value)
    return f"Fastest settling with one limit relaxed: {listed}. Most helpful: {best_relaxation}"

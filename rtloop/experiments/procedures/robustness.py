"""Effect of a resonance at another frequency than the model's: one step in closed loop on each shifted rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import numpy as np
from pydantic import Field

from rtloop.design.palette import Palette
from rtloop.design.verification.text import format_range
from rtloop.experiments.largest_amplitudes import largest_step_up
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.recorded_run import RecordedRun, Trip
from rtloop.experiments.setting import Setting
from rtloop.experiments.timeline import Run, hold
from rtloop.experiments.traces import envelope
from rtloop.experiments.verdict import Analysis, Table
from rtloop.foundation.arrays import Real
from rtloop.foundation.options import Numbers, Options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_SWING_UM = 0.5
"""Swing of the last fifth, from peak to peak, above which a step has not settled."""


class RobustnessOptions(Options):
    """Options: shifts of the resonance's frequency in %, and the step of the reference."""

    shifts_percent: Numbers = Field(default=(-12.0, -10.0, -8.0, -5.0, -2.0, 0.0, 1.0, 2.0, 3.0, 5.0), min_length=1)
    """Shifts of the rig's resonance, with a recording for each."""
    step_um: float = Field(default=20.0, gt=0)
    """Height of the step of the reference, reduced by default to fit limits and interlocks."""
    duration_s: float = Field(default=1.0, ge=0.2)
    """Duration of each recording after the step; its last fifth decides whether the step settled."""


class Outcome(NamedTuple):
    """Result of one shift: the remaining swing, from peak to peak, the largest |x|, and the trip if there was one."""

    shift_percent: float
    swing_um: float
    largest_um: float
    trip: Trip | None

    @property
    def is_settled(self) -> bool:
        """Whether the step neither trips nor rings at the end."""
        return self.trip is None and self.swing_um <= MAX_SWING_UM

    @property
    def text(self) -> str:
        """The outcome as text: "settles", "keeps ringing", or "trips" with the causes in brackets."""
        if self.trip:
            return f"trips ({', '.join(self.trip['causes'])})"
        return "settles" if self.is_settled else "keeps ringing"


def runs(options: RobustnessOptions, setting: Setting) -> list[Run]:
    """Plan a run for each shift: rest, then a step in closed loop on the rig with shifted resonance; it may trip."""
    planned_runs = []
    for shift in options.shifts_percent:
        timeline = setting.timeline("closed_loop")
        timeline.add("step", "closed_loop", hold(options.step_um), options.duration_s, shift_percent=shift)
        change = {"dynamics": {"resonance_shift": shift / 100}}
        planned_runs.append(Run(f"{shift:+g} %", timeline, change, may_trip=True))
    return planned_runs


class RobustnessCurves(TypedDict):
    """Position in µm and outcome as text for each shift in %; all outcomes."""

    traces: list[tuple[float, Real, str]]
    outcomes: list[Outcome]
    rate_hz: float


def analyse(recordings: Sequence[RecordedRun], options: RobustnessOptions) -> Analysis[RobustnessCurves]:
    """Evaluate which shifts settle, ring or trip, and the range of shifts about 0 that settle, beside the model's.

    `recordings` has one run for each shift, in any order.
    """
    ordered = sorted(recordings, key=lambda run: run.segments_labelled("step")[0].values["shift_percent"])
    outcomes, traces = [], []
    for run in ordered:
        step = run.segments_labelled("step")[0]
        position = run.signal("position_um")[step.start_tick : step.start_tick + step.ticks]
        trip = run.first_trip
        tail = position[-position.size // 5 :]
        shift = step.values["shift_percent"]
        outcomes.append(Outcome(shift, float(np.ptp(tail)), float(np.abs(position).max()), trip))
        traces.append((shift, position, outcomes[-1].text))
    model = ordered[0].model
    tolerated_shifts = model.tolerated_shifts if model else None
    predicted = (
        {shift: model.is_stable_with_shift(shift) for shift in options.shifts_percent}
        if model and tolerated_shifts
        else None
    )
    table = [[f"{outcome.shift_percent:+g}", _stability_text(predicted, outcome.shift_percent), outcome.text,
              f"{outcome.swing_um:.3f}", f"{outcome.largest_um:.2f}"] for outcome in outcomes]  # fmt: skip
    rows = []
    modelled = (None, None) if predicted is None else range_about_zero(predicted)
    for end, tested_shift, model_shift in zip(("lowest", "highest"), settling_range(outcomes), modelled, strict=True):
        tolerance = next_shift_distance(tested_shift, options.shifts_percent, is_downward=end == "lowest")
        rows.append(ordered[0].row("", f"{end} tested shift that settles", "%", tested_shift, model_shift, tolerance))
    tolerated_text = f"; the model tolerates {format_range(tolerated_shifts)}" if tolerated_shifts else ""
    notes = ["The model's range consists of the tested shifts for which the sampled loop of [axis.controller] and "
    f"[axis.model] is stable{tolerated_text}. The tolerance is the distance to the next tested shift.",
             "The hysteresis widens the range: within its dead band the command does not reach the actuator, and a "
             "ringing that is small enough dies away by its own damping although the linear loop is unstable. Only a "
             "ringing that leaves the dead band grows, until the interlocks of the configuration trip."]  # fmt: skip
    headings = ("shift / %", "model", "run", "x in the last fifth, peak to peak / µm", "largest |x| / µm")
    curves: RobustnessCurves = {"traces": traces, "outcomes": outcomes, "rate_hz": ordered[0].rate_hz}
    return Analysis(rows, curves, (Table("Every shift", headings, table),), notes)


def settling_range(outcomes: Sequence[Outcome]) -> tuple[float, float]:
    """Return the ends, %, of the range of tested shifts about 0 in which each settles; (NaN, NaN) without any.

    The range is empty if shift 0 was tested and does not settle.
    """
    return range_about_zero({outcome.shift_percent: outcome.is_settled for outcome in outcomes})


def range_about_zero(is_good: Mapping[float, bool]) -> tuple[float, float]:
    """Return the least and the greatest good shift without a bad shift between 0 and it; (NaN, NaN) without any.

    `is_good` is by shift. If 0 is bad, there is none.
    """
    good_shifts, bad_shifts = ([s for s, value in is_good.items() if value is expected] for expected in (True, False))
    lowest_bad, highest_bad = (
        min((s for s in bad_shifts if s >= 0), default=np.inf),
        max((s for s in bad_shifts if s <= 0), default=-np.inf),
    )
    stable_shifts = [s for s in good_shifts if highest_bad < s < lowest_bad]
    return (min(stable_shifts), max(stable_shifts)) if stable_shifts else (np.nan, np.nan)


def next_shift_distance(shift: float, shifts: Sequence[float], is_downward: bool) -> float:
    """Distance from `shift` to the next of `shifts` above it, or below it if `is_downward`; 0 without one."""
    distances = [
        abs(other_shift - shift)
        for other_shift in shifts
        if (other_shift < shift if is_downward else other_shift > shift)
    ]
    return min(distances, default=0.0)


def _stability_text(predicted: Mapping[float, bool] | None, shift_percent: float) -> str:
    """Return the model's prediction for a shift as text, "stable" or "unstable"; a dash if `predicted` is None."""
    return "–" if predicted is None else "stable" if predicted[shift_percent] else "unstable"


def draw(figure: Figure, curves: RobustnessCurves, ink: Palette) -> None:
    """Draw the step at each shift, coloured by its outcome; `curves` come from `analyse`."""
    traces = curves["traces"]
    columns = min(5, len(traces))
    rows = -(-len(traces) // columns)
    panels = np.atleast_1d(figure.subplots(rows, columns, sharex=True, sharey=True)).ravel()
    for number, (panel, (shift, position, outcome_text)) in enumerate(zip(panels, traces, strict=False)):
        color = (
            ink.measured if outcome_text == "settles" else ink.limit if outcome_text.startswith("keeps") else ink.error
        )
        panel.plot(*envelope(position, curves["rate_hz"], 600), color=color, linewidth=0.8)
        label = f"{shift:+g} %" if shift else "0 %"
        ink.label(
            panel, "time / s" if number // columns == rows - 1 else "", "x / µm" if number % columns == 0 else "", label
        )
        panel.text(
            0.96,
            0.06,
            outcome_text.replace(" (", "\n("),
            transform=panel.transAxes,
            color=color,
            fontsize=8,
            ha="right",
        )
    for panel in panels[len(traces) :]:
        panel.set_visible(False)


EXPERIMENT = Experiment(
    "robustness",
    "A resonance that differs from the model's",
    "The same step in closed loop on simulated rigs whose resonance is shifted.",
    RobustnessOptions,
    runs,
    analyse,
    draw,
    limits={"step_um": largest_step_up},
    needs_rig=True,
    size=(11.0, 5.0),
)

"""What a resonance does that is not where the model has it: one step in closed loop on each shifted rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from hil.options import Numbers, Options
from rtloop.experiments import paper
from rtloop.experiments.procedure import CLOSED_PEAK, Experiment, Run, Setting, hold
from rtloop.experiments.taken import Taken
from rtloop.experiments.theme import Ink
from rtloop.experiments.traces import envelope
from rtloop.experiments.verdict import Analysis, Row, Table

REST_S = 0.1
RINGS_UM = 0.5
"""A last fifth that still swings by more than this, from peak to peak, has not settled."""


class RobustnessOptions(Options):
    """Shifts of the resonance's frequency, and the step."""

    shifts_percent: Numbers = Field(default=(-12.0, -10.0, -8.0, -5.0, -2.0, 0.0, 1.0, 2.0, 3.0, 5.0), min_length=1)
    step_um: float = Field(default=20.0, gt=0)
    duration_s: float = Field(default=1.0, ge=0.2)


class Outcome(NamedTuple):
    """Of one shift: how far it still swings at the end, from peak to peak, the largest |x|, and a trip if it came."""

    shift_percent: float
    swing_um: float
    largest_um: float
    trip: Mapping[str, Any] | None

    @property
    def settles(self) -> bool:
        """Neither tripped nor ringing."""
        return self.trip is None and self.swing_um <= RINGS_UM

    @property
    def words(self) -> str:
        """For the table."""
        if self.trip:
            return f"trips ({', '.join(self.trip['causes'])})"
        return "settles" if self.settles else "goes on ringing"


def runs(options: RobustnessOptions, setting: Setting) -> list[Run]:
    """One for each shift."""
    found = []
    for shift in options.shifts_percent:
        timeline = setting.timeline()
        timeline.add("rest", "closed_loop", hold(0.0), REST_S)
        timeline.add("step", "closed_loop", hold(options.step_um), options.duration_s, shift_percent=shift)
        change = {"dynamics": {"resonance_shift": shift / 100}}
        found.append(Run(f"{shift:+g} %", timeline, change, may_trip=True))
    return found


def analyse(recordings: Sequence[Taken], options: RobustnessOptions) -> Analysis:
    """Which shifts settle, ring, trip."""
    ordered = sorted(recordings, key=lambda taken: taken.labelled("step")[0].values["shift_percent"])
    outcomes, traces = [], []
    for taken in ordered:
        step = taken.labelled("step")[0]
        position = taken.signal("position_um")[step.start_tick : step.start_tick + step.ticks]
        trip = taken.trip
        last = position[-position.size // 5 :]
        shift = step.values["shift_percent"]
        outcomes.append(Outcome(shift, float(np.ptp(last)), float(np.abs(position).max()), trip))
        traces.append((shift, position, outcomes[-1].words))
    low, high = stable_range(outcomes)
    table = [[f"{one.shift_percent:+g}", "stable" if _predicted(one.shift_percent) else "unstable", one.words,
              f"{one.swing_um:.3f}", f"{one.largest_um:.2f}"] for one in outcomes]  # fmt: skip
    shifts = [one.shift_percent for one in outcomes]
    rows = [
        Row("lowest tested shift that settles", "%", low, model=paper.STABLE_SHIFT_PERCENT[0],
            tolerance=low - max((shift for shift in shifts if shift < low), default=low)),
        Row("highest tested shift that settles", "%", high, model=paper.STABLE_SHIFT_PERCENT[1],
            tolerance=min((shift for shift in shifts if shift > high), default=high) - high),
    ]  # fmt: skip
    notes = ["The paper does not discuss it. The model's range is that of C(z), tustin prewarped at 595.5 Hz, with "
             "D(s) behind a hold at 10 kHz: −5.65 … +1.80 %. In continuous time it is −3.9 … +2.4 %. The tolerance "
             "is the distance to the next shift that was tried.",
             "The hysteresis widens the range: within its dead band the command does not reach the actuator, and a "
             "ringing that is small enough dies away by its own damping although the linear loop is unstable. Only a "
             "ringing that leaves the dead band grows, until the interlocks of the configuration trip."]  # fmt: skip
    headings = ("shift / %", "model at 10 kHz", "run", "last fifth, peak to peak / µm", "largest |x| / µm")
    curves = {"traces": traces, "outcomes": outcomes, "rate_hz": ordered[0].rate_hz}
    return Analysis(rows, curves, (Table("Every shift", headings, table),), notes)


def stable_range(outcomes: Sequence[Outcome]) -> tuple[float, float]:
    """Lowest and highest shift that settles with no worse one between it and 0; NaN where 0 itself does not."""
    settled = {one.shift_percent for one in outcomes if one.settles}
    bad = [one.shift_percent for one in outcomes if not one.settles]
    above, below = min((s for s in bad if s >= 0), default=np.inf), max((s for s in bad if s <= 0), default=-np.inf)
    inside = [s for s in settled if below < s < above]
    return (min(inside), max(inside)) if inside else (np.nan, np.nan)


def _predicted(shift_percent: float) -> bool:
    return paper.STABLE_SHIFT_PERCENT[0] < shift_percent < paper.STABLE_SHIFT_PERCENT[1]


def draw(figure: Any, curves: Mapping[str, Any], ink: Ink) -> None:
    """The step at each shift."""
    traces = curves["traces"]
    columns = min(5, len(traces))
    rows = -(-len(traces) // columns)
    panels = np.atleast_1d(figure.subplots(rows, columns, sharex=True, sharey=True)).ravel()
    for number, (panel, (shift, position, words)) in enumerate(zip(panels, traces, strict=False)):
        color = ink.measured if words == "settles" else ink.paper if words.startswith("goes") else ink.error
        panel.plot(*envelope(position, curves["rate_hz"], 600), color=color, linewidth=0.8)
        label = f"{shift:+g} %" if shift else "0 %"
        ink.label(
            panel, "time / s" if number // columns == rows - 1 else "", "x / µm" if number % columns == 0 else "", label
        )
        panel.text(
            0.96, 0.06, words.replace(" (", "\n("), transform=panel.transAxes, color=color, fontsize=8, ha="right"
        )
    for panel in panels[len(traces) :]:
        panel.set_visible(False)


EXPERIMENT = Experiment(
    "robustness",
    "A resonance that is not where the model has it",
    "not in the paper",
    "The same step in closed loop on simulated rigs whose resonance is shifted.",
    RobustnessOptions,
    runs,
    analyse,
    draw,
    commanded={"step_um": CLOSED_PEAK},
    needs_rig=True,
    size=(11.0, 5.0),
)

"""The disturbance of the specification: Ω = 3.285 µm added to the actuator's displacement, as a step and as sines.

x = S D Ω in closed loop, so that the error at rest is −x
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from hil.linear import Real
from hil.options import Numbers, Options
from rtloop.experiments import paper
from rtloop.experiments.lockin import tone
from rtloop.experiments.procedure import Experiment, Run, Setting, hold
from rtloop.experiments.taken import Taken, whole
from rtloop.experiments.theme import Ink
from rtloop.experiments.verdict import Analysis, Row, Table

REST_S, STEP_S, SHOWN_S, SETTLE_S = 0.2, 1.0, 0.15, 0.5
LEAST_S = 0.5
ALLOWED_UM = 0.1
"""Ten times the noise of the paper's sensor."""


class DisturbanceOptions(Options):
    """Ω."""

    amplitude_um: float = Field(default=3.285, gt=0)
    frequencies_hz: Numbers = (1.0, 2.9, 10.0, 50.0)


def runs(options: DisturbanceOptions, setting: Setting) -> list[Run]:
    """One for the step and one for each sine: the rig's disturbance is fixed when it is built."""
    found = [_run("step", {"step_um": options.amplitude_um}, STEP_S, setting, settle_s=0.0)]
    for hz in options.frequencies_hz:
        duration_s = np.ceil(max(LEAST_S * hz, 2.0)) / hz
        change = {"sine_um": options.amplitude_um, "sine_hz": hz}
        found.append(_run(f"{hz:g} Hz", change, duration_s, setting, settle_s=SETTLE_S, frequency_hz=hz))
    return found


def _run(
    label: str, change: dict[str, float], duration_s: float, setting: Setting, settle_s: float, **values: Any
) -> Run:
    timeline = setting.timeline()
    timeline.add("rest", "closed_loop", hold(0.0), REST_S)
    disturbance = {**change, "start_s": timeline.ticks / setting.rate_hz}
    measured_ticks = round(duration_s * setting.rate_hz)
    timeline.add("disturbed", "closed_loop", hold(0.0), settle_s + duration_s, measured_ticks=measured_ticks, **values)
    return Run(label, timeline, {"disturbance": disturbance})


def analyse(recordings: Sequence[Taken], options: DisturbanceOptions) -> Analysis:
    """What is left of the step over time, and of each sine."""
    rows: list[Row] = []
    table: list[list[str]] = []
    curves: dict[str, Any] = {"sines": []}
    as_printed = options.amplitude_um == 3.285
    for taken in recordings:
        position = taken.signal("position_um")
        rest, segment = taken.labelled("rest")[0], taken.labelled("disturbed")[0]
        judged = taken.tail(segment, segment.values["measured_ticks"])
        if "frequency_hz" not in segment.values:
            left = position[whole(segment)] - position[whole(rest)].mean()
            rows += _step_rows(left, taken.rate_hz, as_printed)
            shown = round(SHOWN_S * taken.rate_hz)
            curves |= {"time_ms": 1e3 * np.arange(shown) / taken.rate_hz, "step": left[:shown]}
            continue
        hz = segment.values["frequency_hz"]
        left_nm = 1e3 * abs(tone(position[judged], hz, taken.rate_hz).amplitude)
        at = np.array([hz])
        model_nm = 1e3 * options.amplitude_um * abs(paper.sensitivity(at) * paper.dynamics(at))[0]
        rows.append(Row(f"what is left at {hz:g} Hz", "nm", left_nm, paper.SAID_NEGLIGIBLE, model_nm, 0.1 * model_nm))
        table.append([f"{hz:g}", f"{left_nm:.1f}", f"{left_nm / options.amplitude_um / 1e3:.5f}"])
        curves["sines"].append((hz, left_nm))
    curves["amplitude_um"] = options.amplitude_um
    notes = ["Ω is added before D(s), as in eq (7); D(0) makes 3.321 µm of it at rest. The model is S·D of eqs (5) and "
             "(20): the 100 nm that are asked for hold below 2.9 Hz only.",
             "The loop at rest moves within the dead band of the hysteresis, which the inverse does not know: slow "
             "remainders decay more slowly than the linear model's."]  # fmt: skip
    tables = (Table("Sines", ("f / Hz", "amplitude left / nm", "per Ω"), table),) if table else ()
    return Analysis(rows, curves, tables, notes)


def _step_rows(left: Real, rate_hz: float, as_printed: bool) -> list[Row]:
    outside = np.flatnonzero(np.abs(left) > ALLOWED_UM)
    within_ms = 1e3 * (outside[-1] + 1) / rate_hz if outside.size else 0.0
    static_nm = 1e3 * float(abs(left[-left.size // 5 :].mean()))
    model = (paper.DISTURBANCE_UM, paper.DISTURBANCE_MS, paper.DISTURBANCE_STATIC_NM) if as_printed else (None,) * 3
    return [
        Row("largest error after the step", "nm", 1e3 * float(left.max()), paper.SAID_NEGLIGIBLE,
            model[0] and 1e3 * model[0], 100.0),
        Row("within 100 nm of it after", "ms", within_ms, model=model[1], tolerance=5.0),
        Row("static error after the step", "nm", static_nm, paper.SAID_NEGLIGIBLE, model[2], 3.0),
    ]  # fmt: skip


def draw(figure: Any, curves: Mapping[str, Any], ink: Ink) -> None:
    """The step's decay, and what is left over frequency."""
    step, left = figure.subplots(1, 2, width_ratios=(3, 2))
    step.axhspan(-ALLOWED_UM, ALLOWED_UM, color=ink.paper, alpha=0.25, linewidth=0, label="±100 nm, as specified")
    step.plot(curves["time_ms"], curves["step"], color=ink.measured, label="position x")
    step.margins(x=0)
    ink.label(step, "time since the step of Ω / ms", "x / µm", f"step of {curves['amplitude_um']:g} µm")
    ink.legend(step)
    hz = np.geomspace(0.1, 1000.0, 2000)
    model = 1e3 * curves["amplitude_um"] * np.abs(paper.sensitivity(hz) * paper.dynamics(hz))
    left.loglog(hz, model, color=ink.model, linewidth=0.9, label="S·D of eqs (5) and (20)")
    if curves["sines"]:
        left.loglog(*zip(*curves["sines"], strict=True), "o", color=ink.measured, label="measured")
    left.axhline(100.0, color=ink.paper, linewidth=1.2, linestyle="--", label="100 nm, as specified")
    ink.label(left, "frequency of Ω / Hz", "amplitude of x / nm", f"sines of {curves['amplitude_um']:g} µm")
    ink.legend(left)


EXPERIMENT = Experiment(
    "disturbance",
    "Rejection of the disturbance",
    "specification b)",
    "Ω of 3.285 µm in the simulated rig, as a step and as sines, with the loop closed at rest.",
    DisturbanceOptions,
    runs,
    analyse,
    draw,
    needs_rig=True,
)

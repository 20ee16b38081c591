"""Fig 7: what the inverse hysteresis leaves, without feedback."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from hil.options import Options
from rtloop.design.loop_shape import loop_shape
from rtloop.experiments import paper
from rtloop.experiments.procedure import Experiment, Run, Setting, hold, sine
from rtloop.experiments.taken import Taken, whole
from rtloop.experiments.theme import Ink
from rtloop.experiments.traces import thinned
from rtloop.experiments.verdict import Analysis, Row

REST_S = 0.1


class CompensationOptions(Options):
    """The command v."""

    amplitude_um: float = Field(default=40.0, gt=0)
    frequency_hz: float = Field(default=0.1, gt=0)
    cycles: float = Field(default=2.0, ge=1.5)


def runs(options: CompensationOptions, setting: Setting) -> list[Run]:
    """A slow sine of the command, from rest."""
    timeline = setting.timeline()
    timeline.add("rest", "feedforward", hold(0.0), REST_S)
    timeline.add(
        "sine",
        "feedforward",
        sine(options.amplitude_um, options.frequency_hz),
        options.cycles / options.frequency_hz,
    )
    return [Run("", timeline)]


def analyse(recordings: Sequence[Taken], options: CompensationOptions) -> Analysis:
    """y = x/D(0) over v: the loop that is left, its error, its slope ρ and Ω."""
    (taken,) = recordings
    reference, position = taken.read("reference_um", "position_um")
    rest, segment = taken.labelled("rest")[0], taken.labelled("sine")[0]
    offset = position[whole(rest)].mean()
    part = whole(segment)
    v, y = reference[part][:-1], (position[part][1:] - offset) / taken.static_gain
    shape = loop_shape(v, y)
    steady = slice(int(v.size * 0.5 / options.cycles), None)
    gain = float(v[steady] @ y[steady] / (v[steady] @ v[steady]))
    error, omega = v - y, y - gain * v
    paper_amplitude = options.amplitude_um == 40.0
    rows = [
        Row("h/H after compensation", "%", shape.percent, paper.SAID_RESIDUAL,
            paper.RESIDUAL_PERCENT if paper_amplitude else None, 0.1),
        Row("h after compensation", "µm", shape.height, paper.SAID_HEIGHT_LEFT),
        Row("largest |v − y|", "µm", float(np.abs(error).max()),
            model=paper.RESIDUAL_UM if paper_amplitude else None, tolerance=0.1),
        Row("ρ, slope of y over v", "1", gain, paper.SAID_GAIN),
        Row("largest |Ω| = |y − ρ v|", "µm", float(np.abs(omega).max()), paper.SAID_OMEGA),
    ]  # fmt: skip
    notes = ["y is x/D(0), with D(0) of [axis.model]; at 0.1 Hz the dynamics do nothing else.",
             "The paper's model, eq (4) behind its own exact inverse, leaves its dead band r0 alone: 0.747 µm. With "
             "the inverse as printed in eq (6), rounded to two digits, it would leave 2.92 µm.",
             "|Ω| < 3 µm uses the full height of the loop; half of it bounds Ω."]  # fmt: skip
    if taken.truth == "residual":
        notes.append("The simulated actuator was chosen to leave 3.75 %; that this run finds it shows that rig, "
                     "inverse and analysis agree, and nothing about the paper's laboratory.")  # fmt: skip
    return Analysis(rows, {"v_y_error": thinned(v, y, error)}, notes=notes)


def draw(figure: Any, curves: Mapping[str, Any], ink: Ink) -> None:
    """y over v, and what is left of it."""
    loop, rest = figure.subplots(1, 2)
    v, y, error = curves["v_y_error"]
    ends = np.array([v.min(), v.max()])
    loop.plot(ends, ends, color=ink.faint, linewidth=1.0, linestyle="--", label="y = v")
    loop.plot(v, y, color=ink.measured, label="measured")
    ink.label(loop, "command v / µm", "output y / µm", "Fig 7: output of the inverse compensation")
    ink.legend(loop)
    rest.axhline(0, color=ink.faint, linewidth=0.8)
    rest.plot(v, error, color=ink.error, linewidth=1.0)
    ink.label(rest, "command v / µm", "ε = v − y / µm", "what compensation leaves")


EXPERIMENT = Experiment(
    "compensation",
    "Inverse compensation alone",
    "Fig 7",
    "Feedforward without feedback: the command is a slow sine, the inverse hysteresis makes the drive of it.",
    CompensationOptions,
    runs,
    analyse,
    draw,
    commanded={"amplitude_um": 1.02},
    needs_controller=False,
)

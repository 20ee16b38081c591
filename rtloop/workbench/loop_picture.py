"""Picture of loops: open loop, sensitivity and step, a column for each axis. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from rtloop.analysis.closed_loop import REFERENCE_NOT_LINEAR, Loop
from rtloop.analysis.step_response import SETTLING_BAND, step_response
from rtloop.design.figures import create_figure, label_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEAST_HZ = 0.01
COLUMN_INCH, HEIGHT_INCH = 6.5, 9.0
LINE_COLOUR = "0.35"


def draw_loops(loops: Mapping[str, Mapping[str, Loop]]) -> Figure:
    """Return a picture of `loops`, by axis and then by label in the legend: a column for each axis with |L|, |S|, step.

    Raises MissingExtra without matplotlib.
    """
    figure, panels = create_figure(3, len(loops), (COLUMN_INCH * len(loops), HEIGHT_INCH), squeeze=False)
    for (axis, loops_by_label), (open_panel, sensitivity_panel, step_panel) in zip(
        loops.items(), panels.T, strict=True
    ):
        for number, (label, loop) in enumerate(loops_by_label.items()):
            _draw_responses(open_panel, sensitivity_panel, loop, label, f"C{number}")
            _draw_step(step_panel, loop, label, f"C{number}")
        open_panel.axhline(1, color=LINE_COLOUR, linewidth=0.8)
        step_panel.axhspan(1 - SETTLING_BAND, 1 + SETTLING_BAND, color="0.9", label=f"±{100 * SETTLING_BAND:g} %")
        label_panel(open_panel, "frequency / Hz", "|L|", f"axis {axis}: open loop")
        label_panel(sensitivity_panel, "frequency / Hz", "|S|", "sensitivity")
        label_panel(step_panel, "time / ms", "x per unit step", "step on the model")
    return figure


def _draw_responses(open_panel: Axes, sensitivity_panel: Axes, loop: Loop, label: str, color: str) -> None:
    """Draw |L| and |S| of a loop over its own frequencies, for a sampled loop up to 0.49 times its rate."""
    hz = loop.frequencies
    hz = hz[(hz >= LEAST_HZ) & (hz <= (np.inf if loop.period_s is None else 0.49 / loop.period_s))]
    open_panel.loglog(hz, np.abs(loop.open(hz)), color=color, label=label)
    sensitivity_panel.loglog(hz, loop.sensitivity(hz), color=color, label=label)


def _draw_step(panel: Axes, loop: Loop, label: str, color: str) -> None:
    """Draw the position after a unit step; without a figure for the step, only the label."""
    if not loop.is_stable or loop.reference_fault:
        panel.plot([], [], color=color, label=f"{label}: {'unstable' if not loop.is_stable else REFERENCE_NOT_LINEAR}")
        return
    response = step_response(loop)
    panel.plot(1e3 * response.time_s, response.position, color=color, label=label)

"""Pictures of a verification: the open loop, the sensitivities against their templates, the step.

Templates ("gabarits" in the paper) are 1/W1 for |S| and 1/W2 for |CS|, eq (14): as specified, and relaxed by the factor
γ that the controller reaches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rtloop.analysis.closed_loop import REFERENCE_NOT_LINEAR, Loop
from rtloop.analysis.step_response import step_response
from rtloop.design.figures import create_figure, finish_figure
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.design.verification.verify import Verification
from rtloop.foundation.arrays import Real
from rtloop.linear.transfer import Transfer
from rtloop.values import count_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CONTINUOUS_COLOR, RUNNING_COLOR, TEMPLATE_COLOR = "tab:blue", "tab:red", "0.35"


def draw_pictures(verification: Verification, specification: SpecificationOptions, title: str) -> dict[str, bytes]:
    """Return PNG bytes by name: "bode", "sensitivity", "step". Raises MissingExtra without matplotlib."""
    files: dict[str, bytes] = {}
    for name, (draw, *y_labels, x_label) in PICTURES.items():
        figure, panels = create_figure(2, 1, (10, 7), sharex=True)
        draw(panels, verification, specification)
        for panel, label in zip(panels, y_labels, strict=True):
            panel.set_ylabel(label)
        panels[1].set_xlabel(x_label)
        files[name] = finish_figure(figure, panels, f"{title}: {name}")
    return files


def _loops(verification: Verification) -> list[tuple[str, Loop, str]]:
    """Return label, loop and colour of each loop: continuous, if there is one, then running."""
    rate = 1 / verification.running.period_s if verification.running.period_s else math.nan
    running_label = f"loop as it runs: {rate:g} Hz, {count_text(verification.delay_ticks, 'sample')} of delay"
    continuous_rows = (
        [] if verification.continuous is None else [("continuous", verification.continuous, CONTINUOUS_COLOR)]
    )
    return [*continuous_rows, (running_label, verification.running, RUNNING_COLOR)]


def _plotted_hz(loop: Loop, verification: Verification) -> Real:
    """Return the frequencies (k,) in Hz at which `loop` is drawn: its own grid from 0.01 Hz up to a limit.

    The limit is ten times the sampling rate of the running loop; for a sampled `loop` 0.49 times its rate.
    """
    hz = loop.frequencies
    period_s = verification.running.period_s or 1e-12
    return hz[(hz >= 1e-2) & (hz <= (10 if loop.period_s is None else 0.49) / period_s)]


def _bode(panels: Sequence[Axes], verification: Verification, _: SpecificationOptions) -> None:
    """Draw magnitude and phase of L."""
    for label, loop, color in _loops(verification):
        hz = _plotted_hz(loop, verification)
        response = loop.open(hz)
        panels[0].loglog(hz, np.abs(response), color=color, label=f"|L| {label}")
        panels[1].semilogx(hz, np.degrees(np.unwrap(np.angle(response))), color=color, label=f"phase of L, {label}")
    panels[0].axhline(1, color=TEMPLATE_COLOR, linewidth=0.8)
    panels[1].axhline(-180, color=TEMPLATE_COLOR, linewidth=0.8, linestyle=":")


def _sensitivity(panels: Sequence[Axes], verification: Verification, _: SpecificationOptions) -> None:
    """Draw |S| and |CS|, with their templates if there are weights."""
    for label, loop, color in _loops(verification):
        hz = _plotted_hz(loop, verification)
        panels[0].loglog(hz, loop.sensitivity(hz), color=color, label=f"|S| {label}")
        panels[1].loglog(hz, loop.command_sensitivity(hz), color=color, label=f"|CS| {label}")
    if verification.weights is not None:
        hz = _plotted_hz(verification.continuous or verification.running, verification)
        _template(panels[0], hz, verification.weights.tracking, "W1", verification.gamma)
        _template(panels[1], hz, verification.weights.command, "W2", verification.gamma)


def _template(panel: Axes, hz: Real, weight: Transfer, name: str, gamma: float | None) -> None:
    """Draw 1/|W| as specified and, for a finite `gamma`, relaxed by it."""
    inverse = 1 / np.abs(weight.response(2j * np.pi * hz))
    panel.loglog(hz, inverse, color=TEMPLATE_COLOR, linestyle="--", label=f"1/{name}, as specified")
    if gamma is not None and math.isfinite(gamma):
        panel.loglog(hz, gamma * inverse, color=TEMPLATE_COLOR, linestyle=":", label=f"γ/{name}, γ = {gamma:.3g}")


def _step(panels: Sequence[Axes], verification: Verification, specification: SpecificationOptions) -> None:
    """Draw position and command after a unit step, with their limits."""
    duration_s = 4e-3 * (specification.settling_ms or 5.0)
    for label, loop, color in _loops(verification):
        if not loop.is_stable or loop.reference_fault:
            fault = "unstable" if not loop.is_stable else REFERENCE_NOT_LINEAR
            for panel in panels:
                panel.plot([], [], color=color, label=f"{label}: {fault}")
            continue
        response = step_response(loop, duration_s)
        style: dict[str, Any] = (
            {"color": color} if loop.period_s is None else {"color": color, "drawstyle": "steps-post"}
        )
        panels[0].plot(1e3 * response.time_s, response.position, label=f"x {label}", color=color)
        panels[1].plot(1e3 * response.time_s, response.command, label=f"v {label}", **style)
    panels[0].axhspan(0.95, 1.05, color="0.9", label="±5 %")
    if specification.settling_ms is not None:
        panels[0].axvline(
            specification.settling_ms, color=TEMPLATE_COLOR, linestyle="--", label="settled by, as specified"
        )
    if specification.command is not None:
        largest_command = specification.command.command_um / specification.command.reference_um
        panels[1].axhline(largest_command, color=TEMPLATE_COLOR, linestyle="--", label="largest v, as specified")
    panels[1].set_xlim(0, 1e3 * duration_s)


PICTURES = {
    "bode": (_bode, "|L|", "phase / °", "frequency / Hz"),
    "sensitivity": (_sensitivity, "|S|", "|CS|", "frequency / Hz"),
    "step": (_step, "x per unit step", "v per unit step", "time / ms"),
}
"""Drawing function of each picture, with the labels of its two panels and of their common axis."""

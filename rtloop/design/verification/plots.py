"""Pictures of a verification: the open loop, the sensitivities against their templates, the step.

The only module of the design that draws. Templates ("gabarits" in the paper) are 1/W1 for |S| and 1/W2 for |CS|, eq
(14): as specified, and relaxed by the factor γ that the controller reaches.
"""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np

from rtloop.analysis.closed_loop import Loop
from rtloop.analysis.step_response import step_response
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.design.verification.verify import Verification
from rtloop.errors import MissingExtra
from rtloop.foundation.arrays import Real
from rtloop.linear.transfer import Transfer

CONTINUOUS_COLOR, RUNNING_COLOR, TEMPLATE_COLOR = "tab:blue", "tab:red", "0.35"


def draw_pictures(verification: Verification, specification: SpecificationOptions, title: str) -> dict[str, bytes]:
    """Return PNG files by name: bode, sensitivity, step. Raises MissingExtra without matplotlib."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("pictures need matplotlib: pip install 'rtloop[plot]'") from None
    files: dict[str, bytes] = {}
    for name, draw in (("bode", _bode), ("sensitivity", _sensitivity), ("step", _step)):
        figure = Figure(figsize=(10, 7), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(2, 1, sharex=True)
        draw(panels, verification, specification)
        for panel in panels:
            panel.grid(visible=True, which="both", alpha=0.2)
            panel.legend(fontsize=8, framealpha=0.9)
        figure.suptitle(f"{title}: {name}", fontsize=11)
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=110)
        files[name] = file.getvalue()
    return files


def _loops(verification: Verification) -> list[tuple[str, Loop, str]]:
    rate = 1 / verification.running.period_s if verification.running.period_s else math.nan
    running_label = f"as it runs: {rate:g} Hz, {verification.delay_ticks} samples of delay"
    continuous_rows = (
        [] if verification.continuous is None else [("continuous", verification.continuous, CONTINUOUS_COLOR)]
    )
    return [*continuous_rows, (running_label, verification.running, RUNNING_COLOR)]


def _frequencies(loop: Loop, verification: Verification) -> Real:
    """Return frequencies from 0.01 Hz to ten times the sampling rate, or to just below half of it for C(z)."""
    hz = loop.frequencies
    period_s = verification.running.period_s or 1e-12
    return hz[(hz >= 1e-2) & (hz <= (10 if loop.period_s is None else 0.49) / period_s)]


def _bode(panels: Any, verification: Verification, _: SpecificationOptions) -> None:
    for label, loop, color in _loops(verification):
        hz = _frequencies(loop, verification)
        response = loop.open(hz)
        panels[0].loglog(hz, np.abs(response), color=color, label=f"|L| {label}")
        panels[1].semilogx(hz, np.degrees(np.unwrap(np.angle(response))), color=color, label=f"phase of L, {label}")
    panels[0].axhline(1, color=TEMPLATE_COLOR, linewidth=0.8)
    panels[1].axhline(-180, color=TEMPLATE_COLOR, linewidth=0.8, linestyle=":")
    panels[0].set_ylabel("|L|")
    panels[1].set_ylabel("phase / °")
    panels[1].set_xlabel("frequency / Hz")


def _sensitivity(panels: Any, verification: Verification, _: SpecificationOptions) -> None:
    for label, loop, color in _loops(verification):
        hz = _frequencies(loop, verification)
        panels[0].loglog(hz, loop.sensitivity(hz), color=color, label=f"|S| {label}")
        panels[1].loglog(hz, loop.command_sensitivity(hz), color=color, label=f"|CS| {label}")
    if verification.weights is not None:
        hz = _frequencies(verification.continuous or verification.running, verification)
        _template(panels[0], hz, verification.weights.tracking, "W1", verification.gamma)
        _template(panels[1], hz, verification.weights.command, "W2", verification.gamma)
    panels[0].set_ylabel("|S|, error per reference")
    panels[1].set_ylabel("|CS|, command per reference")
    panels[1].set_xlabel("frequency / Hz")


def _template(panel: Any, hz: Real, weight: Transfer, name: str, gamma: float | None) -> None:
    inverse = 1 / np.abs(weight.response(2j * np.pi * hz))
    panel.loglog(hz, inverse, color=TEMPLATE_COLOR, linestyle="--", label=f"1/{name}, as specified")
    if gamma is not None and math.isfinite(gamma):
        panel.loglog(hz, gamma * inverse, color=TEMPLATE_COLOR, linestyle=":", label=f"γ/{name}, γ = {gamma:.3g}")


def _step(panels: Any, verification: Verification, specification: SpecificationOptions) -> None:
    duration_s = 4e-3 * (specification.settling_ms or 5.0)
    for label, loop, color in _loops(verification):
        if not loop.is_stable:
            panels[0].plot([], [], color=color, label=f"{label}: unstable")
            panels[1].plot([], [], color=color, label=f"{label}: unstable")
            continue
        response = step_response(loop, duration_s)
        style = {"color": color} if loop.period_s is None else {"color": color, "drawstyle": "steps-post"}
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
    panels[0].set_ylabel("x per unit step")
    panels[1].set_ylabel("v per unit step")
    panels[1].set_xlabel("time / ms")
    panels[1].set_xlim(0, 1e3 * duration_s)

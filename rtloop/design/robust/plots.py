"""Picture of taps: overshoot against settling time, and the step that was chosen."""

from __future__ import annotations

import io

import numpy as np

from rtloop.design.robust.programme import BAND
from rtloop.design.robust.shape import Subject, TapDesign
from rtloop.design.verification.plots import CONTINUOUS_COLOR, RUNNING_COLOR, TEMPLATE_COLOR
from rtloop.errors import MissingExtra


def draw_taps(tap_design: TapDesign, subject: Subject, title: str) -> bytes:
    """A PNG file. Raises MissingExtra without matplotlib."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("pictures need matplotlib: pip install 'rtloop[plot]'") from None
    figure = Figure(figsize=(10, 9), layout="constrained")
    FigureCanvasAgg(figure)
    trade, position, command = figure.subplots(3, 1)
    if tap_design.curve:
        settling, overshoots = np.array(tap_design.curve).T
        trade.semilogy(
            settling, 100 * np.maximum(overshoots, 1e-6), color=RUNNING_COLOR, marker="o", label="least overshoot"
        )
    trade.axhline(100 * subject.overshoot, color=TEMPLATE_COLOR, linestyle="--", label="overshoot, as specified")
    trade.axvline(tap_design.settling_ms, color=CONTINUOUS_COLOR, linestyle=":", label="chosen")
    trade.set_xlabel("settling time / ms, in every scenario")
    trade.set_ylabel("overshoot / %")
    time, x, v = tap_design.step
    period_s = subject.controller.period_s
    position.plot(1e3 * time, x, color=RUNNING_COLOR, label="x on the model, between ticks too")
    position.axhspan(1 - BAND, 1 + BAND, color="0.9", label=f"±{100 * BAND:g} %")
    position.set_ylabel("x per unit step")
    command.step(1e3 * period_s * np.arange(v.size), v, where="post", color=RUNNING_COLOR, label="v on the model")
    command.set_ylabel("v per unit step")
    command.set_xlabel("time / ms")
    for panel in (position, command):
        panel.set_xlim(0, 4 * tap_design.settling_ms)
    for panel in (trade, position, command):
        panel.grid(visible=True, which="both", alpha=0.2)
        panel.legend(fontsize=8, framealpha=0.9)
    figure.suptitle(f"{title}: taps", fontsize=11)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return file.getvalue()

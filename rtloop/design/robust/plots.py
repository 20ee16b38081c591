"""Picture of taps: overshoot against settling time, and the step that was chosen."""

from __future__ import annotations

import numpy as np

from rtloop.design.figures import create_figure, finish_figure
from rtloop.design.robust.programme import BAND
from rtloop.design.robust.shape import Subject, TapDesign
from rtloop.design.verification.plots import CONTINUOUS_COLOR, RUNNING_COLOR, TEMPLATE_COLOR


def draw_taps(tap_design: TapDesign, subject: Subject, title: str) -> bytes:
    """Return the picture of `tap_design` as PNG. Raises MissingExtra without matplotlib."""
    figure, panels = create_figure(3, 1, (10, 9))
    trade, position, command = panels
    if tap_design.curve:
        settling, overshoots = np.array(tap_design.curve).T
        trade.semilogy(
            settling, 100 * np.maximum(overshoots, 1e-6), color=RUNNING_COLOR, marker="o", label="least overshoot"
        )
    trade.axhline(100 * subject.overshoot, color=TEMPLATE_COLOR, linestyle="--", label="overshoot, as specified")
    trade.axvline(tap_design.settling_ms, color=CONTINUOUS_COLOR, linestyle=":", label="chosen")
    trade.set(xlabel="settling time / ms, in every scenario", ylabel="overshoot / %")
    time, x, v = tap_design.step
    period_s = subject.controller.period_s
    position.plot(1e3 * time, x, color=RUNNING_COLOR, label="position x of the model, also between ticks")
    position.axhspan(1 - BAND, 1 + BAND, color="0.9", label=f"±{100 * BAND:g} %")
    command.step(
        1e3 * period_s * np.arange(v.size), v, where="post", color=RUNNING_COLOR, label="command v of the model"
    )
    range_ms = (0, 4 * tap_design.settling_ms)
    position.set(ylabel="x per unit step", xlim=range_ms)
    command.set(ylabel="v per unit step", xlabel="time / ms", xlim=range_ms)
    return finish_figure(figure, panels, f"{title}: taps")

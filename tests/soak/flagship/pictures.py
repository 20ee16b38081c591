"""Pictures of the comparison, in the colours of reports."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.design.palette import Palette, draw_pictures
from rtloop.foundation.arrays import Real
from tests.soak.flagship.stage import Steps
from tests.soak.flagship.stepped import RETUNED, SHIFTS, TRACED, TRACED_UM

SHOWN_MS = 20.0
LABELS = {"ours": "taps of robust.toml", "wide": "taps made for ±10 %", "retuned": "retuned"}


def draw(folder: Path, curves: Mapping[str, Any]) -> None:
    """Write a PNG file for each picture with curves, for light and for dark screens."""
    for name, (drawing, size) in {
        "steps": (_steps, (11.0, 5.5)),
        "loops": (_loops, (11.0, 6.5)),
        "shift": (_shift, (11.0, 4.5)),
        "scans": (_scans, (11.0, 4.0)),
        "draws": (_draws, (11.0, 4.0)),
    }.items():
        if name in curves:
            for theme, png in draw_pictures(drawing, curves[name], size).items():
                (folder / f"{name}-{theme}.png").write_bytes(png)


def _colours(ink: Palette) -> dict[str, str]:
    """Return the colour of each loop."""
    return {"paper": ink.error, "ours": ink.measured, "wide": ink.comparison, "retuned": ink.drive}


def _steps(figure: Any, traces: Mapping[str, Mapping[float, tuple[Real, Real]]], ink: Palette) -> None:
    """Draw one step of every loop, with the resonance as modelled and 10 % to either side."""
    panels = figure.subplots(2, 3, sharex=True, sharey="row")
    labels = {"paper": "the paper's C", "ours": "rtloop's own", "retuned": "its taps retuned"}
    for column, percent in enumerate(TRACED):
        wide, near = panels[:, column]
        for tolerance, label, alpha in ((0.05, "±5 %", 0.2), (0.001, "±0.1 %", 0.7)):
            band = (1 - tolerance) * TRACED_UM, (1 + tolerance) * TRACED_UM
            near.axhspan(*band, color=ink.faint, alpha=alpha, linewidth=0, label=label)
        for name, label_text in labels.items():
            ms, um = traces[name][percent]
            is_shown = ms < SHOWN_MS
            for panel in (wide, near):
                panel.plot(ms[is_shown], um[is_shown], color=_colours(ink)[name], label=label_text, linewidth=1.1)
        wide.set_ylim(-0.2 * TRACED_UM, 1.5 * TRACED_UM)
        near.set_ylim(0.94 * TRACED_UM, 1.06 * TRACED_UM)
        ink.label(wide, "", "" if column else "x / µm", f"resonance {f'{percent:+g} %' if percent else 'as modelled'}")
        ink.label(near, "time since the step / ms", "" if column else "x / µm, enlarged")
    ink.add_legend(panels[0, 1], loc="lower right")
    ink.add_legend(panels[1, 1], loc="lower right")


def _loops(figure: Any, curves: Mapping[str, Any], ink: Palette) -> None:
    """Draw |L|, its phase and |S|: on the model, and as bands over all scenarios."""
    panels = figure.subplots(3, 2, sharex=True, sharey="row")
    for column, (name, title) in enumerate((("paper", "the paper's C"), ("ours", "rtloop's own"))):
        loop, colour = curves[name], _colours(ink)[name]
        gain, phase, sensitivity = panels[:, column]
        gain.fill_between(loop["hz"], *loop["open_band"], color=colour, alpha=0.25, linewidth=0, label="every scenario")
        gain.plot(loop["hz"], loop["open"], color=colour, label="on the model")
        gain.axhline(0, color=ink.faint, linewidth=0.8)
        phase.plot(loop["hz"], loop["phase"], color=colour)
        stable = f"the {loop['stable']} of {loop['of']} scenarios that are stable"
        sensitivity.fill_between(
            loop["hz"], *loop["sensitivity_band"], color=colour, alpha=0.25, linewidth=0, label=stable
        )
        sensitivity.plot(loop["hz"], loop["sensitivity"], color=colour, label="on the model")
        sensitivity.axhline(2, color=ink.limit, linestyle="--", linewidth=1, label="2, the goal")
        sensitivity.set_yscale("log")
        sensitivity.set_ylim(1e-3, 30.0)
        gain.set_xscale("log")
        gain.set_ylim(-60.0, 60.0)
        ink.label(gain, "", "" if column else "|L| / dB", title)
        ink.label(phase, "", "" if column else "phase of L / °")
        ink.label(sensitivity, "frequency / Hz", "" if column else "|S|")
        ink.add_legend(gain)
        ink.add_legend(sensitivity, loc="lower right")


def _shift(figure: Any, runs: Mapping[str, Mapping[float, Steps]], ink: Palette) -> None:
    """Draw settling and overshoot of eight steps over the shift of the resonance."""
    settling, over = figure.subplots(1, 2)
    for name, places in (("paper", SHIFTS), ("ours", SHIFTS), ("wide", SHIFTS), ("retuned", RETUNED)):
        label = LABELS.get(name, "the paper's C, where it does not trip")
        loop_runs = [runs[name][percent] for percent in places]
        style = {"color": _colours(ink)[name], "marker": "o", "markersize": 3, "label": label, "linewidth": 1.0}
        settling.plot(places, [_finite(run.settling_ms) for run in loop_runs], **style)
        over.plot(places, [_finite(run.overshoot(40.0)) for run in loop_runs], **style)
    settling.set_yscale("log")
    _label_ticks(settling.yaxis, (3, 4, 5, 6, 8, 10))
    over.set_yscale("log")
    ink.label(settling, "shift of the resonance / %", "settling to 5 % / ms, worst of eight steps", "Settling")
    ink.label(over, "shift of the resonance / %", "overshoot of 40 µm / %", "Overshoot")
    ink.add_legend(settling)


def _label_ticks(axis: Any, ticks: tuple[int, ...]) -> None:
    """Label a logarithmic axis with plain numbers."""
    axis.set_ticks(ticks, [f"{tick}" for tick in ticks])
    axis.set_ticks([], minor=True)


def _finite(value: float) -> float:
    """Return the value, or nan for an infinite one, which is not drawn."""
    return value if np.isfinite(value) else np.nan


def _scans(figure: Any, errors: Mapping[str, Any], ink: Palette) -> None:
    """Draw the rms error of triangles from cycle to cycle."""
    panels = figure.subplots(1, 3, sharey=True)
    colours = {"-10": ink.comparison, "+0": ink.measured, "+10": ink.drive}
    for number, (panel, (hz, goal)) in enumerate(zip(panels, errors["goals"].items(), strict=True)):
        panel.axhline(errors["paper"][number][0], color=ink.error, label="the paper's C, resonance as modelled")
        panel.axhline(goal, color=ink.limit, linestyle="--", label="goal")
        for percent, colour in colours.items():
            panel.plot(errors[percent][number], marker="o", markersize=3, color=colour, label=f"resonance {percent} %")
        panel.set_yscale("log")
        ink.label(panel, "cycle of learning", "rms error / % of 40 µm" if panel is panels[0] else "", f"{hz} Hz")
    ink.add_legend(panels[0])


def _draws(figure: Any, figures: Mapping[str, Any], ink: Palette) -> None:
    """Draw the share of the drawn rigs that do no worse than a value."""
    panels = figure.subplots(1, 2, sharey=True)
    for name in ("paper", "ours", "wide"):
        for column, panel in enumerate(panels):
            values = np.sort(figures[name][:, column])
            shares = 100 * np.arange(1, values.size + 1) / values.size
            finite = np.isfinite(values)
            label = LABELS.get(name, "the paper's C")
            panel.step(values[finite], shares[finite], where="post", color=_colours(ink)[name], label=label)
    for panel, label_text in zip(panels, ("settling to 5 % / ms", "overshoot of 40 µm / %"), strict=True):
        panel.set_xscale("log")
        panel.set_ylim(0.0, 102.0)
        ink.label(panel, label_text, "rigs that do no worse / %" if panel is panels[0] else "")
    _label_ticks(panels[0].xaxis, (3, 4, 5, 6, 8, 10))
    ink.add_legend(panels[1], loc="lower right")

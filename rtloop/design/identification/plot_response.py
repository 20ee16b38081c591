"""A picture of a measured loop over the model's: L in magnitude and phase, |S|, and L near −1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rtloop.design.figures import create_figure, label_panel, save_figure
from rtloop.foundation.arrays import Complex, Real

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MEASURED_COLOR, MODEL_COLOR = "tab:blue", "0.15"
PLANE_LIMIT = 2.0
"""Limit of the axes in the plane of L, to each side."""


def plot_response(measurement: Mapping[str, Any], output: Path) -> None:
    """Write a PNG of a `LoopMeasurement`, given as its JSON mapping, to `output`, over an existing file.

    Raises OutputError if `output` cannot be written, MissingExtra without matplotlib.
    """
    curves = measurement["response"]
    hz, loop, spread = np.array(curves["hz"]), _complex(curves["loop"]), np.array(curves["loop_spread"], float)
    model = _complex(curves["model_loop"]) if "model_loop" in curves else None
    figure, ((magnitude, plane), (phase, sensitivity)) = create_figure(2, 2, (12, 8))
    margins = measurement["margins"]
    _plot_with_spread(magnitude, hz, np.abs(loop), np.abs(loop) * spread)
    size = np.abs(_complex(curves["sensitivity"]))
    _plot_with_spread(sensitivity, hz, size, size * np.array(curves["sensitivity_spread"], float))
    phase.semilogx(hz, np.degrees(np.unwrap(np.angle(loop))), ".-", color=MEASURED_COLOR, markersize=3, linewidth=0.8)
    plane.plot(loop.real, loop.imag, ".-", color=MEASURED_COLOR, markersize=3, linewidth=0.8, label="measured")
    if model is not None:
        magnitude.loglog(hz, np.abs(model), color=MODEL_COLOR, linewidth=0.8, label="model")
        promised = np.abs(_complex(curves["model_sensitivity"]))
        sensitivity.loglog(hz, promised, color=MODEL_COLOR, linewidth=0.8, label="model")
        phase.semilogx(hz, np.degrees(np.unwrap(np.angle(model))), color=MODEL_COLOR, linewidth=0.8)
        plane.plot(model.real, model.imag, color=MODEL_COLOR, linewidth=0.8, label="model")
    plane.plot([-1], [0], "+", color="tab:red", markersize=10)
    plane.set(xlim=(-PLANE_LIMIT, PLANE_LIMIT), ylim=(-PLANE_LIMIT, PLANE_LIMIT), aspect="equal")
    magnitude.axhline(1, color="0.6", linewidth=0.6)
    label_panel(magnitude, "frequency / Hz", "|L|", f"loop: gain margin {_format_margin(margins['gain_margin'])}")
    label_panel(
        phase,
        "frequency / Hz",
        "phase of L / °",
        f"phase margin {_format_margin(margins['phase_margin_deg'])} °",
        legend=False,
    )
    label_panel(sensitivity, "frequency / Hz", "|S|", f"largest |S| {_format_margin(margins['max_sensitivity'])}")
    label_panel(plane, "Re L", "Im L", f"modulus margin {_format_margin(margins['modulus_margin'])}")
    save_figure(figure, output)


def _plot_with_spread(panel: Axes, hz: Real, size: Real, std: Real) -> None:
    """Plot a measured magnitude with a band of ± two standard deviations."""
    panel.loglog(hz, size, ".-", color=MEASURED_COLOR, markersize=3, linewidth=0.8, label="measured")
    panel.fill_between(
        hz, np.maximum(size - 2 * std, 1e-9), size + 2 * std, color=MEASURED_COLOR, alpha=0.2, label="±2σ"
    )


def _complex(pairs: Sequence[Sequence[float | None]]) -> Complex:
    """Return pairs [real, imaginary] as complex numbers (k,); a part that is None becomes NaN."""
    parts = np.array(pairs, dtype=float)
    return parts[:, 0] + 1j * parts[:, 1]


def _format_margin(margin: Mapping[str, float | None]) -> str:
    """Return a margin as text, "value ± std", with "–" for a std that is None; "–" alone for a value that is None."""
    if margin["value"] is None:
        return "–"
    std = "–" if margin["std"] is None else f"{margin['std']:.2g}"
    return f"{margin['value']:.4g} ± {std}"

"""Pictures for light paper and for dark screens."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest

from rtloop.design.palette import DPI, Palette, draw_pictures

SIZE_IN = (6.0, 4.0)


def plot_curve(figure: Any, curve: Any, ink: Palette) -> None:
    """Plot a curve with large numbers, and below it the curve with a title, names of its axes and a legend."""
    upper, lower = figure.subplots(2, 1)
    upper.plot(1e6 * curve, color=ink.drive)
    lower.plot(curve, label="measured", color=ink.measured)
    ink.label(lower, "time (s)", "position (µm)", "Motion", "upper right")


def test_each_picture_equals_one_that_matplotlib_lays_out_alone():
    figure_module = pytest.importorskip("matplotlib.figure", reason="matplotlib is not installed")
    alone: list[bytes] = []

    def draw(figure: Any, curve: Any, ink: Palette) -> None:
        """Plot a curve, here and in a figure of its own, which is stored in `alone`."""
        plot_curve(figure, curve, ink)
        own = figure_module.Figure(figsize=SIZE_IN, layout="constrained")
        plot_curve(own, curve, ink)
        file = io.BytesIO()
        own.savefig(file, format="png", dpi=DPI)
        alone.append(file.getvalue())

    images = draw_pictures(draw, np.sin(np.arange(100)), SIZE_IN)
    assert list(images) == ["light", "dark"]
    assert list(images.values()) == alone
    assert images["light"] != images["dark"]

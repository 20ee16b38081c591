"""Style of the pictures: colours for light paper and for dark screens, and parts that all panels share."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from rtloop.recording.views.picture import load_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.typing import LegendLocType, RcKeyType

DPI = 130
Curves = TypeVar("Curves")


@dataclass(frozen=True)
class Palette:
    """Colours of a picture, by meaning."""

    background: str
    text: str
    faint: str
    measured: str
    model: str
    error: str
    drive: str
    comparison: str
    limit: str

    def label(self, panel: Axes, x: str, y: str, title: str = "", legend: LegendLocType | None = None) -> None:
        """Label the axes of a panel, give it a title, and a transparent legend at the location `legend`, matplotlib's
        name for it; None: no legend.
        """
        panel.set_xlabel(x)
        panel.set_ylabel(y)
        panel.set_title(title, loc="left", fontsize=10, fontweight="bold")
        if legend is not None:
            self.add_legend(panel, legend)

    def add_legend(self, panel: Axes, loc: LegendLocType = "best") -> None:
        """Add a transparent legend to a panel at `loc`, matplotlib's name of the location."""
        panel.legend(loc=loc, fontsize=8, framealpha=0.85, edgecolor="none", facecolor=self.background)


LIGHT = Palette("#ffffff", "#1c2024", "#8a919b", "#1f6fb2", "#2b3036", "#d62728", "#2a8c2a", "#8257b5", "#c4700a")
DARK = Palette("#14171a", "#e4e7ea", "#7f8791", "#5aa9e6", "#d5dade", "#ff6b6b", "#5fcf6a", "#b794f4", "#f0a94a")
THEMES: Mapping[str, Palette] = {"light": LIGHT, "dark": DARK}


def draw_pictures(
    draw: Callable[[Figure, Curves, Palette], None], curves: Curves, size: tuple[float, float]
) -> dict[str, bytes]:
    """Return a picture as PNG bytes for each theme, "light" and "dark"; `size` in inches.

    `draw(figure, curves, palette)` draws it. Raises MissingExtra without matplotlib.
    """
    matplotlib = load_matplotlib()
    images: dict[str, bytes] = {}
    first: Figure | None = None
    for name, ink in THEMES.items():
        with matplotlib.rc_context(_matplotlib_settings(ink)):
            figure = matplotlib.figure.Figure(figsize=size, layout="constrained" if first is None else None)
            matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
            draw(figure, curves, ink)
            if first is not None:
                _copy_layout(first, figure)
            file = io.BytesIO()
            figure.savefig(file, format="png", dpi=DPI)
        images[name], first = file.getvalue(), figure
    return images


def _copy_layout(source: Figure, target: Figure) -> None:
    """Place each panel of `target` where the panel of `source` with the same index stands.

    The figures differ in their colours only. matplotlib's own layout takes half of the time to draw a picture.
    """
    for source_panel, panel in zip(source.axes, target.axes, strict=True):
        panel.set_position(source_panel.get_position())


def _matplotlib_settings(ink: Palette) -> dict[RcKeyType, object]:
    """Return matplotlib's settings (rcParams) for a palette as a dictionary."""
    return {
        "figure.facecolor": ink.background,
        "axes.facecolor": ink.background,
        "savefig.facecolor": ink.background,
        "text.color": ink.text,
        "axes.labelcolor": ink.text,
        "axes.edgecolor": ink.faint,
        "xtick.color": ink.text,
        "ytick.color": ink.text,
        "xtick.labelsize": 8,
        "ytick.labelsize": 8,
        "axes.labelsize": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.color": ink.faint,
        "grid.alpha": 0.25,
        "grid.linewidth": 0.6,
        "lines.linewidth": 1.4,
        "lines.solid_capstyle": "round",
    }

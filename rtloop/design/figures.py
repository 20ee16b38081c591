"""Figures for all pictures of the design: panels, labels, PNG files. Needs matplotlib."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.errors import output_errors
from rtloop.foundation.trusted import overwrite_file
from rtloop.recording.views.picture import DOTS_PER_INCH, create_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def create_figure(rows: int, columns: int, size: tuple[float, float] = (12, 5), **options: Any) -> tuple[Figure, Any]:
    """Return a new figure and its panels: one panel, an array (n,) for a single row or column, else (rows, columns).

    `size` is width and height in inches, `options` go to `Figure.subplots`. Raises MissingExtra without matplotlib.
    """
    figure = create_picture(*size)
    return figure, figure.subplots(rows, columns, **options)


def label_panel(panel: Axes, x: str, y: str, title: str, *, legend: bool = True) -> None:
    """Add axis labels, title, grid and, by default, a legend to a panel."""
    panel.set(xlabel=x, ylabel=y)
    panel.set_title(title, fontsize=10)
    panel.grid(alpha=0.3)
    if legend:
        panel.legend(fontsize=8)


def finish_figure(figure: Figure, panels: Iterable[Axes], title: str) -> bytes:
    """Add a grid and a legend to each of `panels`, and the title to the figure. Returns the figure as PNG bytes."""
    for panel in panels:
        panel.grid(visible=True, which="both", alpha=0.2)
        panel.legend(fontsize=8, framealpha=0.9)
    figure.suptitle(title, fontsize=11)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()


def save_figure(figure: Figure, output: Path) -> None:
    """Write the figure as PNG to `output`, over an existing file. Raises OutputError if this fails."""
    with output_errors(output), os.fdopen(overwrite_file(output), "wb") as file:
        figure.savefig(file, format="png", dpi=DOTS_PER_INCH)

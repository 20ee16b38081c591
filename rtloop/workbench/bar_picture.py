"""Picture of figures as bars. Needs matplotlib."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from rtloop.recording.views.picture import create_picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_bars(title: str, names: Sequence[str], values: Mapping[str, Sequence[float | None]]) -> Figure:
    """Return a picture with a row of bars for each of `names`: one bar for each of `values`.

    `values` has, by label in the legend, a length for each name; None draws no bar. Raises MissingExtra without
    matplotlib.
    """
    figure = create_picture(8.0, 1.5 + 0.4 * len(names))
    panel = figure.subplots()
    rows, height = np.arange(len(names)), 0.8 / len(values)
    for number, (label, bars) in enumerate(values.items()):
        lengths = [math.nan if bar is None else bar for bar in bars]
        panel.barh(rows + number * height, lengths, height, label=label)
    panel.set_yticks(rows + 0.4 - height / 2, names)
    panel.invert_yaxis()
    panel.grid(visible=True, axis="x", alpha=0.3)
    panel.legend(fontsize=8)
    panel.set_title(title, fontsize=10)
    return figure

"""Pictures: figures of matplotlib that a notebook shows by itself."""

from __future__ import annotations

import io
from types import ModuleType
from typing import TYPE_CHECKING

from rtloop.errors import MissingExtra
from rtloop.foundation.trusted import standing_elsewhere

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS_PER_INCH = 110


def load_matplotlib() -> ModuleType:
    """Return matplotlib with `figure` and `backends.backend_agg`; a matplotlibrc of the current folder is not read.

    Raises MissingExtra without matplotlib.
    """
    try:
        with standing_elsewhere():
            import matplotlib
        import matplotlib.backends.backend_agg
        import matplotlib.figure
    except ImportError:
        raise MissingExtra("a picture needs matplotlib: pip install 'rtloop[plot]'") from None
    return matplotlib


def create_picture(width_inch: float, height_inch: float) -> Figure:
    """Return a new, empty figure that pyplot does not hold, and that a notebook shows as PNG without pyplot.

    Raises MissingExtra without matplotlib.
    """

    class Picture(load_matplotlib().figure.Figure):
        """Figure with the method that notebooks look for."""

        def _repr_png_(self) -> bytes:
            """Return the figure as PNG."""
            file = io.BytesIO()
            self.savefig(file, format="png", dpi=DOTS_PER_INCH)
            return file.getvalue()

    return Picture(figsize=(width_inch, height_inch), layout="constrained")

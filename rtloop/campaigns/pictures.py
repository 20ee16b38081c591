"""Pictures of a campaign, as PNG bytes by theme: figures, rigs over two keys, sensitivity indices, recordings, pairs.

The themes are "light" and "dark". Every function that returns pictures raises MissingExtra without matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.campaigns.sensitivity import SensitivityIndex
from rtloop.design.palette import Palette, draw_pictures
from rtloop.foundation.arrays import Real
from rtloop.recording.load import Recording
from rtloop.recording.views.bands import Band, Mark, event_marks, read_bands
from rtloop.values import count_text

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEWEST_BINS, MOST_BINS = 10, 40
"""Bins of a histogram between the least and the largest value, by the number of values."""
DRAWN_BINS = 80
"""Most bins between the ends of a histogram's axis, which the limit and the nominal rig widen."""
LOGARITHMIC_RATIO = 10.0
"""Ratio of the largest to the least value from which an axis is logarithmic."""
OUTLIER_SPANS = 1.5
"""Spans between the 5 % and the 95 % quantile beyond the latter, from which on values lie beyond a histogram's axis."""
MARKED_RIGS = 200
"""Most rigs beyond a limit that a histogram marks one by one."""
DRAWN_RIGS = 5000
"""Most rigs of a picture with a mark for each rig."""
POINTS = 1500
"""Groups of ticks of a drawn recording; least and largest value of each are drawn."""
COLUMNS = 3
"""Most panels side by side."""


class FigureValues(NamedTuple):
    """Values (rigs,) of a figure, its limit, and the nominal rig's value; NaN for a rig without a value."""

    name: str
    values: Real
    limit: float
    nominal: float


class KeyValues(NamedTuple):
    """Values (rigs,) of a key and the nominal rig's value, NaN for none; numbers 0, 1 … stand for `texts` if any."""

    name: str
    values: Real
    nominal: float
    texts: tuple[str, ...] = ()


class RigPlane(NamedTuple):
    """Rigs over two keys; `passed` (rigs,) are truth values."""

    x: KeyValues
    y: KeyValues
    passed: npt.NDArray[np.bool_]


class RecordedMotion(NamedTuple):
    """Bands of reference and true position of one axis in µm, and marks of trips, gaps and failures of the driver."""

    reference: Band
    position: Band
    faults: list[Mark]


def draw_histogram(figure_values: FigureValues) -> dict[str, bytes]:
    """Return PNG bytes by theme: the histogram of a figure's finite values, its limit and the nominal rig's value."""
    return draw_pictures(_draw_histogram, figure_values, (5.6, 3.3))


def draw_rigs(plane: RigPlane) -> dict[str, bytes]:
    """Return PNG bytes by theme: the first DRAWN_RIGS rigs over two keys, a dot if passed, a cross if failed."""
    return draw_pictures(_draw_rigs, plane, (7.0, 4.8))


def draw_sensitivity(indices: Mapping[str, Mapping[str, SensitivityIndex]]) -> dict[str, bytes]:
    """Return PNG bytes by theme: bars of both indices of each key, with their intervals, a panel for each quantity.

    `indices` are by quantity and by key.
    """
    rows, keys = -(-len(indices) // COLUMNS), max(map(len, indices.values()))
    return draw_pictures(_draw_sensitivity, indices, (11.0, 0.9 + rows * (0.9 + 0.55 * keys)))


def draw_motions(motions: Mapping[str, RecordedMotion]) -> dict[str, bytes]:
    """Return PNG bytes by theme: reference and true position of a rig, a panel for each experiment.

    `motions` are by the experiment's name.
    """
    rows = -(-len(motions) // COLUMNS)
    return draw_pictures(_draw_motions, motions, (11.0, 0.7 + 2.5 * rows))


def read_motion(recording: Recording) -> RecordedMotion:
    """Return the motion of the axis whose true position has the largest difference between its extremes.

    Raises RecordingError for a recording without a tick, and for one without true positions.
    """
    names = [(f"{axis}_reference_um", f"{axis}_true_position_um") for axis in recording.header["axes"]]
    bands = read_bands(recording, [name for pair in names for name in pair], 0.0, np.inf, POINTS)
    reference, position = max(names, key=lambda pair: np.ptp([bands[pair[1]].low, bands[pair[1]].high]))
    marks = event_marks(recording, 0.0, np.inf)
    return RecordedMotion(bands[reference], bands[position], [mark for mark in marks if mark.bad])


def draw_pairs(pairs: Sequence[tuple[FigureValues, FigureValues]]) -> dict[str, bytes]:
    """Return PNG bytes by theme: figures of two campaigns, a panel for each pair, a dot for each rig.

    The first campaign's value of a rig is on the x axis, the second's on the y axis.
    """
    rows = -(-len(pairs) // COLUMNS)
    return draw_pictures(_draw_pairs, pairs, (11.0, 0.4 + 3.6 * rows))


def _panels(figure: Figure, count: int) -> list[Any]:
    """Add `count` panels to a figure of matplotlib, at most COLUMNS in a row; return the panels, row by row."""
    grid = figure.add_gridspec(-(-count // COLUMNS), min(count, COLUMNS))
    return [figure.add_subplot(grid[divmod(number, COLUMNS)]) for number in range(count)]


def _add_legend(figure: Figure, ink: Palette, entries: Mapping[str, Artist] | None = None) -> None:
    """Add a legend below all panels; `entries` has the line or bar of each label, None: as in the first panel.

    Adds no legend without a label.
    """
    if entries is None:
        handles, labels = figure.axes[0].get_legend_handles_labels()
        entries = dict(zip(labels, handles, strict=True))
    if entries:
        figure.legend(
            entries.values(), entries.keys(), loc="outside lower center", ncols=4, fontsize=8, edgecolor="none",
            facecolor=ink.background,
        )  # fmt: skip


def _escape_math(text: str) -> str:
    """Return the text with each "$" escaped, so that matplotlib reads no part of it as mathematics."""
    return text.replace("$", r"\$")


def _finite(*numbers: float) -> Real:
    """Return the numbers that are finite."""
    return np.array([number for number in numbers if np.isfinite(number)])


def _scale_axis(panel: Axes, name: str, values: Real) -> bool:
    """Scale the axis `name`, "x" or "y", of a panel for finite values (n,); return whether it is logarithmic.

    The axis is logarithmic if all values are positive and the largest is at least LOGARITHMIC_RATIO times the least. A
    linear axis of whole numbers has ticks at whole numbers only.
    """
    from matplotlib.ticker import LogLocator

    axis = getattr(panel, f"{name}axis")
    if not values.size or values.min() <= 0 or values.max() < LOGARITHMIC_RATIO * values.min():
        axis.get_major_locator().set_params(integer=bool(np.all(values == np.round(values))))
        return False
    panel.set(**{f"{name}scale": "log"})
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if values.max() < 1000 * values.min() else (1.0,)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")
    return True


def _bin_edges(values: Real, limit: float, drawn: Real, is_logarithmic: bool) -> Real:
    """Return the edges, rising, of bins over finite values (n,), n ≥ 1, on an axis that shows `drawn`, numbers (m,).

    The bins are equally wide, on a logarithmic axis in the logarithm. A finite limit lies on an edge, or on the place
    where one would be.
    """
    if is_logarithmic:
        return 10 ** _bin_edges(np.log10(values), np.log10(limit), np.log10(drawn), False)
    low, high = float(values.min()), float(values.max())
    origin = limit if np.isfinite(limit) else low
    bins = np.clip(2 * np.sqrt(values.size), FEWEST_BINS, MOST_BINS)
    width = max((high - low) / bins, np.ptp(np.append(drawn, values)) / DRAWN_BINS, 1e-6 * abs(low)) or 1.0
    first, last = np.floor((low - origin) / width), np.ceil((high - origin) / width)
    return origin + width * np.arange(first, max(last, first + 1) + 1)


def _draw_histogram(figure: Any, curves: FigureValues, ink: Palette) -> None:
    """Draw the histogram of `curves` on a figure of matplotlib, in the colours `ink`.

    Values beyond the limit have another colour, and a mark each if they are at most MARKED_RIGS.
    """
    panel, values = figure.subplots(), curves.values[np.isfinite(curves.values)]
    values = values[values <= _axis_end(values, curves)]
    beyond = values[values > curves.limit]
    if values.size:
        drawn = np.append(values, _finite(curves.limit, curves.nominal))
        edges = _bin_edges(values, curves.limit, drawn, _scale_axis(panel, "x", drawn))
        groups = {"within the limit": values[~(values > curves.limit)], "beyond the limit": beyond}
        groups = {label: group for label, group in groups.items() if group.size}
        colors = {"within the limit": ink.measured, "beyond the limit": ink.error}
        panel.hist(
            list(groups.values()), edges, stacked=True,
            color=[colors[label] for label in groups], label=list(groups),
        )  # fmt: skip
        panel.yaxis.get_major_locator().set_params(integer=True)
        panel.set_axisbelow(True)
    if 0 < beyond.size <= MARKED_RIGS:
        panel.plot(beyond, np.zeros(beyond.size), "|", color=ink.error, markersize=9, clip_on=False)
    if np.isfinite(curves.limit):
        panel.axvline(curves.limit, color=ink.limit, linestyle="--", label=f"limit {curves.limit:.4g}")
    if np.isfinite(curves.nominal):
        panel.axvline(curves.nominal, color=ink.model, linestyle=":", label=f"nominal rig {curves.nominal:.4g}")
    ink.label(panel, _escape_math(curves.name), "rigs", histogram_title(curves))
    _add_legend(figure, ink)


def _axis_end(values: Real, curves: FigureValues) -> float:
    """Return the largest of the finite `values` (n,), or the end of an axis that leaves out outliers and shows limit
    and nominal rig.

    At most 5 % of the values are outliers: they lie OUTLIER_SPANS beyond the 95 % quantile.
    """
    if not values.size:
        return np.inf
    low, high = np.quantile(values, (0.05, 0.95), method="inverted_cdf")
    end = max([high + OUTLIER_SPANS * (high - low), *_finite(curves.limit, curves.nominal)])
    return float(min(end, values.max())) if high > low else float(values.max())


def histogram_title(curves: FigureValues) -> str:
    """Return in words the number of rigs with a finite value, those with +∞, and a nominal value of +∞, if any.

    Rigs beyond the end of the axis are counted too.
    """
    values, infinite = curves.values[np.isfinite(curves.values)], int(np.count_nonzero(np.isposinf(curves.values)))
    parts = [count_text(values.size, "rig")]
    if (outliers := values[values > _axis_end(values, curves)]).size:
        verb = "lies" if outliers.size == 1 else "lie"
        parts.append(f"{count_text(outliers.size, 'rig')} {verb} beyond this axis, up to {outliers.max():.4g}")
    if infinite:
        parts.append(f"{count_text(infinite, 'more rig')} {'has' if infinite == 1 else 'have'} an infinite value")
    if np.isposinf(curves.nominal):
        parts.append("the nominal rig has an infinite value")
    return "; ".join(parts)


def _draw_rigs(figure: Figure, plane: RigPlane, ink: Palette) -> None:
    """Draw the first DRAWN_RIGS rigs over two keys on a figure of matplotlib, and the nominal rig as a star."""
    panel, passed = figure.subplots(), plane.passed[:DRAWN_RIGS]
    styles: dict[str, Any] = {
        "passed": {"s": 20, "marker": "o", "color": ink.measured, "alpha": 0.8, "linewidths": 0},
        "failed": {"s": 24, "marker": "x", "color": ink.error, "linewidths": 1.1},
    }
    for word, rigs in (("passed", np.flatnonzero(passed)), ("failed", np.flatnonzero(~passed))):
        if rigs.size:
            label = f"{rigs.size:,} {word}"
            panel.scatter(plane.x.values[rigs], plane.y.values[rigs], label=label, **styles[word])
    if np.isfinite(plane.x.nominal) and np.isfinite(plane.y.nominal):
        panel.scatter(
            [plane.x.nominal], [plane.y.nominal], s=190, marker="*", facecolor=ink.background, edgecolor=ink.text,
            linewidths=1.2, label="nominal rig", zorder=3,
        )  # fmt: skip
    for name, key in (("x", plane.x), ("y", plane.y)):
        if key.texts:
            getattr(panel, f"{name}axis").set_ticks(range(len(key.texts)), [*map(_escape_math, key.texts)])
        else:
            _scale_axis(panel, name, np.append(key.values, _finite(key.nominal)))
    ink.label(panel, _escape_math(plane.x.name), _escape_math(plane.y.name))
    _add_legend(figure, ink)


def _draw_sensitivity(figure: Figure, indices: Mapping[str, Mapping[str, SensitivityIndex]], ink: Palette) -> None:
    """Draw two bars for each key: first index above, total index below, and their intervals as lines.

    `figure` is matplotlib's, with a panel for each quantity; `indices` are by quantity and by key.
    """
    panels = _panels(figure, len(indices))
    for number, (panel, (quantity, index_by_key)) in enumerate(zip(panels, indices.items(), strict=True)):
        values, places = np.array(list(index_by_key.values())), np.arange(len(index_by_key))
        for offset, column, color, hatch in ((-0.2, 0, ink.measured, ""), (0.2, 3, ink.comparison, "///")):
            panel.barh(
                places + offset, values[:, column], 0.36, color=color, hatch=hatch, edgecolor=ink.background,
                linewidth=0, label=("key alone (first index)", "key alone and with others (total index)")[column // 3],
            )  # fmt: skip
            panel.hlines(
                places + offset, values[:, column + 1], values[:, column + 2], color=ink.text, linewidth=1.1,
                label="95 % interval" if column else None,
            )  # fmt: skip
        if not np.isfinite(values).any():
            text = "no index: a rig has no finite value,\nall rigs have the same value,\nor there are too few rigs"
            panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", va="center", fontsize=8)
        low, high = np.nanmin([0.0, *values.ravel()]), np.nanmax([1.0, *values.ravel()])
        panel.set_xlim(low - 0.02 * (high - low), high + 0.02 * (high - low))
        panel.set_ylim(len(index_by_key) - 0.5, -0.5)
        panel.set_yticks(places, [_escape_math(key) for key in index_by_key] if number % COLUMNS == 0 else [])
        panel.grid(visible=False, axis="y")
        ink.label(panel, "share of the variance", "", _escape_math(quantity))
    handles, labels = panels[0].get_legend_handles_labels()
    entries = dict(zip(labels, handles, strict=True))
    _add_legend(figure, ink, {label: entries[label] for label in [*labels[1:], *labels[:1]]})


def _draw_motions(figure: Figure, motions: Mapping[str, RecordedMotion], ink: Palette) -> None:
    """Draw reference and true position of each motion, with a line at each fault, on a figure of matplotlib."""
    panels, entries, fault_entries = _panels(figure, len(motions)), {}, {}
    for number, (panel, (name, motion)) in enumerate(zip(panels, motions.items(), strict=True)):
        for label, band, style in (
            ("true position", motion.position, {"color": ink.measured}),
            ("reference", motion.reference, {"color": ink.model, "linestyle": "--"}),
        ):
            extremes_um = np.stack([band.low, band.high], axis=1).ravel()
            panel.plot(np.repeat(band.time_s, 2), extremes_um, linewidth=0.9, label=label, **style)
        for fault in motion.faults:
            line = panel.axvline(fault.time_s, color=ink.error, linestyle=":")
            fault_entries[fault.label.partition(":")[0]] = line
        entries |= {str(line.get_label()): line for line in panel.lines[:2]}
        panel.margins(x=0)
        panel.xaxis.get_major_locator().set_params(nbins=6)
        ink.label(panel, "time / s", "" if number % COLUMNS else "position / µm", _motion_title(name, motion))
    _add_legend(figure, ink, entries | fault_entries)


def _motion_title(name: str, motion: RecordedMotion) -> str:
    """Return the name of an experiment, with the label of its first fault if there is one."""
    return _escape_math(f"{name}, {motion.faults[0].label}" if motion.faults else name)


def _draw_pairs(figure: Figure, pairs: Sequence[tuple[FigureValues, FigureValues]], ink: Palette) -> None:
    """Draw a panel for each pair, on a figure of matplotlib: a dot for each rig, the line of equal values, both limits.

    At most DRAWN_RIGS rigs are drawn, of those with finite values in both campaigns.
    """
    for panel, (first, second) in zip(_panels(figure, len(pairs)), pairs, strict=True):
        finite = np.isfinite(first.values) & np.isfinite(second.values)
        x, y = (side.values[finite][:DRAWN_RIGS] for side in (first, second))
        panel.scatter(x, y, s=16, color=ink.measured, alpha=0.8, linewidths=0)
        span = np.concatenate([x, y, _finite(first.limit, second.limit)])
        for name in ("x", "y"):
            _scale_axis(panel, name, span)
        if span.size:
            panel.plot([span.min(), span.max()], [span.min(), span.max()], color=ink.faint, linewidth=1.0)
        if np.isfinite(first.limit):
            panel.axvline(first.limit, color=ink.limit, linestyle="--", linewidth=1.0)
        if np.isfinite(second.limit):
            panel.axhline(second.limit, color=ink.limit, linestyle="--", linewidth=1.0)
        title = f"{first.name}\n{finite.sum():,} of {finite.size:,} rigs finite in both"
        ink.label(panel, "first campaign", "second campaign", _escape_math(title))

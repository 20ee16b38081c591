"""Result of a run as text: the summary of its recording, and its steps beside the specification's limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rtloop.recording.views.steps import SETTLING_BAND, StepMetrics
from rtloop.workbench.step_figures import MISSED, specification_rows
from rtloop.workbench.summary_text import print_summary
from rtloop.workbench.tables import escape, format_figure, table

if TYPE_CHECKING:
    from rich.console import Console

    from rtloop.configuration.file import Configuration
    from rtloop.recording.views.summary import Summary

SPECIFIED_STEP = (
    "MISSED: the worst recorded step is beyond the limit. `rtloop check` judges a step of the linear loop: where it "
    "misses the limit too, the loop is the reason. A recorded step also has the sensor's noise, hysteresis that the "
    "inverse leaves, limits of command and drive, and the end of its level: what has not settled by then counts. "
    "`rtloop design verify` simulates such steps."
)
"""Difference between a recorded step and the step that a specification limits."""


def print_run(
    out: Console, configuration: Configuration, summary: Summary | None, steps: Mapping[str, StepMetrics]
) -> None:
    """Print the summary of a run, and the figures of its `steps` unless there are none.

    `summary` is None without a recording; then one line states this.
    """
    if summary is None:
        out.print("nothing is recorded")
        return
    print_summary(out, summary)
    if steps:
        print_steps(out, steps, configuration)


def print_steps(out: Console, steps: Mapping[str, StepMetrics], configuration: Configuration | None = None) -> None:
    """Print overshoot (%), settling time (ms) and static error (%) of each axis's steps, the worst and the median.

    With a configuration, limits and claims of the axis's specification follow, and an explanation if a limit is missed.
    """
    is_missed, notes = False, list[str]()
    rows = table("steps", "overshoot %", "settling ms (5 %)", "static error %")
    axes = {axis.name: axis for axis in configuration.axes} if configuration else {}
    for name, metrics in steps.items():
        for label, suffix in ((f"worst of {metrics.steps}", "_worst"), ("median", "")):
            overshoot, settling, error = (
                getattr(metrics, f"{quantity}{suffix}")
                for quantity in ("overshoot_percent", "settling_time_ms", "static_error_percent")
            )
            figures = (format_figure(overshoot, 2), format_figure(settling, 2), format_figure(error, 3))
            rows.add_row(f"{name}: {label}", *figures)
        if metrics.unreached:
            notes.append(
                f"{name}: {metrics.unreached} of {metrics.steps} steps hardly moved, or ended more than "
                f"{100 * SETTLING_BAND:g} % of their height from the reference"
            )
        for row in specification_rows(configuration, axes[name], metrics) if configuration else ():
            label = escape(row.label) if row.error is None else f"[red]{escape(row.error)}[/]"
            rows.add_row(f"  {label}", *(_red(cell) if cell.endswith(MISSED) else escape(cell) for cell in row.cells))
            is_missed |= any(cell.endswith(MISSED) for cell in row.cells)
    out.print(rows)
    for note in notes:
        out.print(_red(note))
    if is_missed:
        out.print(SPECIFIED_STEP)


def _red(text: str) -> str:
    """Return rich's markup for text in red, with the brackets in `text` escaped."""
    return f"[red]{escape(text)}[/]"

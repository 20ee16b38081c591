"""Summary of a recording as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rtloop.values import count_text
from rtloop.workbench.tables import escape, format_number, table

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from rtloop.recording.views.summary import Summary


BAR_WIDTH = 40
UNCONTROLLED_PERCENT = 50.0
"""A loop that was saturated, or not settled, for a larger share of its time is marked red."""
MAX_NAMES = 8
"""Largest number of requesters of commands that the summary names."""


def print_summary(out: Console, summary: Summary) -> None:
    """Print the summary of a recording as tables: size, ticks, rate, problems and trips; timing; error and drive of
    each axis.

    An imported recording gets a table of its signals in place of the axes.
    """
    tick_bytes = summary.bytes_per_tick
    size = f"{summary.size_bytes / 2**20:.1f} MiB" + ("" if tick_bytes is None else f", {tick_bytes:.1f} bytes a tick")
    out.print(f"[bold]{escape(summary.recording)}[/]  {size}")
    rows = table("", "", "")
    expected = summary.ticks_expected
    total_text = "a run without a fixed length" if expected is None else f"{expected:,}"
    rows.add_row("ticks", f"{summary.ticks_logged:,}", f"of {total_text}")
    rows.add_row("lost", str(summary.ticks_lost), "complete" if summary.complete else "[red]not complete[/]")
    if window := summary.around:
        total, stretches = summary.ticks_logged + summary.ticks_skipped, summary.stretches
        extent = (
            f"{count_text(stretches, 'stretch', 'stretches')}, {summary.ticks_logged:,} of {total:,} ticks recorded"
        )
        span = f"{window['before_s']:g} s before and {window['after_s']:g} s after {escape(', '.join(window['on']))}"
        rows.add_row("around events", f"{stretches:,}", f"{extent}: {span}")
    rows.add_row("time", f"{summary.duration_s:.3f} s", f"at {summary.rate_hz:g} Hz")
    if imported := summary.imported:
        rows.add_row("imported", "", f"from {escape(imported['file'])}, time: {escape(imported['time'])}")
        for note in imported["notes"]:
            rows.add_row("", "", escape(note))
    elif summary.paced:
        achieved = summary.achieved_rate_hz
        rate = "–" if achieved is None else f"{achieved:.1f} Hz"
        realtime = summary.realtime or {}
        scheduling = " ".join(str(realtime[key]) for key in ("scheduler", "priority") if realtime.get(key))
        memory = "memory locked" if realtime.get("mlock") else "memory not locked"
        rows.add_row("achieved rate", rate, f"{scheduling or 'scheduler not known'}, {memory}")
        rows.add_row("periods missed", str(summary.periods_missed), "a late tick skips the periods that it misses")
        rows.add_row("overruns", str(summary.overruns), "ticks that ended after their period")
    else:
        rows.add_row("clock", "virtual", "unpaced: nothing was timed")
    if any(summary.ticks_limited.values()):
        counts = ", ".join(f"{name} {count:,}" for name, count in summary.ticks_limited.items() if count)
        rows.add_row("limited", "", f"ticks by cause: {counts}")
    if (summary.saturated_percent or 0.0) > UNCONTROLLED_PERCENT:
        share = f"{summary.saturated_percent:.0f} % of the ticks in closed loop"
        rows.add_row(
            "[red]saturated[/]", "", f"[red]in {share}, the law's output exceeded the limit of command or drive[/]"
        )
    for axis in summary.axes:
        if axis.settled_percent is not None and axis.settled_percent < UNCONTROLLED_PERCENT:
            share = f"{100 - axis.settled_percent:.0f} % of the ticks in closed loop"
            error = f"the error of axis {escape(axis.name)} was larger than {axis.settled_within_um:g} µm"
            rows.add_row("[red]not settled[/]", "", f"[red]in {share}, {error}[/]")
        if axis.opposed:
            opposed = f"the position of axis {escape(axis.name)} fell as its drive rose. Check the sign of its um_per_v"
            remedy = "and the wires of sensor and drive; `rtloop drivers --selftest CONFIG` measures the sign"
            rows.add_row("[red]sign[/]", "", f"[red]{opposed} {remedy}[/]")
    if cut := summary.cut:
        rows.add_row("cut", f"{cut['first']} …", f"to tick {cut['end'] - 1}, of {escape(', '.join(cut['files']))}")
    if len(summary.parts) > 1:
        rows.add_row("parts", str(len(summary.parts)), "of a rotated recording")
    if summary.commands:
        requesters = [f"{requester} {count:,}" for requester, count in summary.commands.items()]
        names = f"by {', '.join(requesters[:MAX_NAMES])}{', …' * (len(requesters) > MAX_NAMES)}"
        rows.add_row("commands", str(sum(summary.commands.values())), escape(names))
    for problem in summary.problems:
        rows.add_row("[red]problem[/]", "", escape(problem))
    if summary.driver_error:
        rows.add_row("[red]driver[/]", "", escape(summary.driver_error))
    for trip in summary.trips:
        reason = escape(trip.reason or "")
        rows.add_row("[red]trip[/]", f"tick {trip.tick}", "; ".join(filter(None, [", ".join(trip.causes), reason])))
    out.print(rows)
    if summary.lateness_us is not None:
        _print_timing(out, summary)
    if summary.imported:
        _print_imported(out, summary)
        return
    axes = table("axis", "rms error µm", "largest drive V")
    for axis in summary.axes:
        axes.add_row(axis.name, format_number(axis.rms_error_um, ".4f"), f"{axis.max_abs_drive_v:.3f}")
    out.print(axes)


def _print_imported(out: Console, summary: Summary) -> None:
    """Print signals with unit and range, and their source in the file of the other program."""
    rows = table("signal", "unit", "least", "largest", "in the file", words=(4,))
    mapping = (summary.imported or {})["mapping"]
    for signal_range in summary.ranges:
        ends = [format_number(end, ".6g") for end in (signal_range.least, signal_range.largest)]
        rows.add_row(signal_range.name, escape(signal_range.unit), *ends, escape(mapping.get(signal_range.name, "")))
    out.print(rows)


def _print_timing(out: Console, summary: Summary) -> None:
    """Print quantiles of lateness and tick time, the histogram of the lateness, and medians of a tick's phases."""
    rows = table("µs", "p50", "p99", "p99.9", "max")
    for label, quantiles in (("lateness", summary.lateness_us), ("tick", summary.exec_us)):
        if quantiles is not None:
            rows.add_row(label, *(f"{quantiles[name]:.2f}" for name in ("p50", "p99", "p999", "max")))
    out.print(rows)
    if summary.lateness_histogram:
        out.print(histogram_table(summary.lateness_histogram, "late by µs"))
    phases = summary.phases
    labels = (("read", "read_us"), ("law", "law_us"), ("write", "write_us"))
    out.print("a tick's time, medians: " + ", ".join(f"{label} {phases[key]:.2f} µs" for label, key in labels))


def histogram_table(histogram: Sequence[Mapping[str, float | None]], heading: str) -> Table:
    """Return a table of counts and percentages from the first to the last class with a count; a full bar is 100 %.

    `histogram` are classes [{below_us, count}, …], ascending; the last one, below_us None, has no upper end.
    """
    import numpy as np

    rows = table(heading, "ticks", "share", "", words=(3,))
    counts = np.array([entry["count"] for entry in histogram])
    edges = ["0", *(f"{entry['below_us']:g}" for entry in histogram[:-1]), ""]
    occupied = np.flatnonzero(counts)
    for k in range(occupied[0], occupied[-1] + 1) if occupied.size else ():
        label = f"{edges[k]} … {edges[k + 1]}" if edges[k + 1] else f"{edges[k]} and more"
        share = counts[k] / counts.sum()
        rows.add_row(label, f"{counts[k]:,}", f"{100 * share:.3g} %", "█" * round(BAR_WIDTH * share))
    return rows

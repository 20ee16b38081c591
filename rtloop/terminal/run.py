"""What the terminal shows: progress of a run, its summary, the list of drivers. No numbers are made here."""

from __future__ import annotations

from collections.abc import Iterator
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rtloop import signals
from rtloop.drivers.errors import DriverError
from rtloop.drivers.registry import driver_class, kinds
from rtloop.errors import RtloopError
from rtloop.recording.load import load
from rtloop.recording.views.steps import SETTLING_BAND, step_metrics
from rtloop.recording.views.summary import Summary
from rtloop.signals import Mode
from rtloop.terminal.progress import StatusLine
from rtloop.terminal.table import console, figure, table
from rtloop.values import count_text

if TYPE_CHECKING:
    from rtloop.configuration.axis import AxisOptions
    from rtloop.configuration.file import Configuration
    from rtloop.configuration.prepare import Prepared
    from rtloop.supervision.supervisor import Supervisor

BAR_WIDTH = 40
STEP_QUANTITIES = ("overshoot_percent", "settling_ms", "static_error_percent")
"""Of a specification, in the order of the table."""
UNCONTROLLED_PERCENT = 50.0
"""A loop that was saturated, or not settled, for a larger share of its time is said not to have controlled."""
MOST = 8
"""Names in a row."""
LONGEST_STEP_ANALYSIS_TICKS = 6_000_000


class RunView(StatusLine):
    """One line on a terminal while the loop runs, nothing where the stream is not a terminal."""

    def __init__(self, prepared: Prepared, stream: IO[str]) -> None:
        super().__init__("starting", stream)
        self._plan = prepared.plan

    def show(self, supervisor: Supervisor) -> None:
        """Time, mode, lateness and the axes of the newest tick."""
        row = supervisor.latest() if self._status else None
        if row is None:
            return
        parts = [_elapsed(row[signals.TICK] / self._plan.pacing.rate_hz, self._plan.ticks, self._plan.pacing.rate_hz)]
        parts.append(Mode(int(row[signals.MODE])).name.lower())
        causes = signals.trip_causes(row[signals.FLAGS])
        if causes:
            parts.append(f"[red]tripped: {', '.join(causes)}[/]")
        if self._plan.pacing.paced:
            parts.append(f"late {row[signals.LATENESS]:6.1f} µs")
        for axis, name in enumerate(self._plan.axes[:4]):
            position, drive = (row[signals.axis_column(axis, which)] for which in (signals.POSITION, signals.DRIVE))
            parts.append(f"{name} {position:8.3f} µm {drive:7.3f} V")
        self.update("   ".join(parts))


def _elapsed(time_s: float, ticks: int | None, rate_hz: float) -> str:
    return f"{time_s:8.1f} s" if ticks is None else f"{time_s:8.1f} of {ticks / rate_hz:g} s"


def print_run(prepared: Prepared, summary: Summary | None) -> None:
    """The summary of a run, if it was recorded, with step metrics where the reference is a series of steps."""
    if summary is None:
        console().print("nothing is recorded")
        return
    print_summary(summary)
    if 0 < summary.ticks_logged <= LONGEST_STEP_ANALYSIS_TICKS and not summary.trips:
        _print_steps(prepared, summary.recording)


def print_summary(summary: Summary) -> None:
    """What a recording holds, as tables."""
    out = console()
    out.print(f"[bold]{escape(summary.recording)}[/]  {_size(summary)}")
    shown = table("", "", "")
    expected = summary.ticks_expected
    shown.add_row(
        "ticks", f"{summary.ticks_logged:,}", "of " + ("as many as came" if expected is None else f"{expected:,}")
    )
    shown.add_row("lost", str(summary.ticks_lost), "complete" if summary.complete else "[red]not complete[/]")
    if around := summary.around:
        came, on = summary.ticks_logged + summary.ticks_skipped, escape(", ".join(around["on"]))
        kept = (
            f"{count_text(summary.stretches, 'stretch', 'stretches')}, {summary.ticks_logged:,} of {came:,} ticks kept"
        )
        shown.add_row("around events", f"{summary.stretches:,}", f"{kept}: {around['before_s']:g} s before and "
                      f"{around['after_s']:g} s after {on}")  # fmt: skip
    shown.add_row("time", f"{summary.duration_s:.3f} s", f"at {summary.rate_hz:g} Hz")
    if imported := summary.imported:
        shown.add_row("imported", "", f"from {escape(imported['file'])}, time: {escape(imported['time'])}")
        for note in imported["notes"]:
            shown.add_row("", "", escape(note))
    elif summary.paced:
        achieved = summary.achieved_rate_hz
        rate = "–" if achieved is None else f"{achieved:.1f} Hz"
        shown.add_row("achieved rate", rate, _scheduling(summary.realtime or {}))
        shown.add_row("periods missed", str(summary.periods_missed), "skipped by late ticks, never caught up")
        shown.add_row("overruns", str(summary.overruns), "ticks that ended after their period")
    else:
        shown.add_row("clock", "virtual", "unpaced: nothing was timed")
    if any(summary.ticks_limited.values()):
        counts = ", ".join(f"{name} {count:,}" for name, count in summary.ticks_limited.items() if count)
        shown.add_row("limited", "", f"ticks by what: {counts}")
    if (summary.saturated_percent or 0.0) > UNCONTROLLED_PERCENT:
        share = f"{summary.saturated_percent:.0f} % of the ticks in closed loop"
        shown.add_row("[red]saturated[/]", "", f"[red]in {share} the law asked for more than command or drive may[/]")
    for axis in summary.axes:
        if axis.settled_percent is not None and axis.settled_percent < UNCONTROLLED_PERCENT:
            share = f"{100 - axis.settled_percent:.0f} % of the ticks in closed loop"
            error = f"the error of {escape(axis.name)} was larger than {axis.settled_within_um:g} µm"
            shown.add_row("[red]not settled[/]", "", f"[red]in {share} {error}[/]")
    if cut := summary.cut:
        shown.add_row("cut", f"{cut['first']} …", f"to tick {cut['end'] - 1}, of {escape(', '.join(cut['files']))}")
    if len(summary.parts) > 1:
        shown.add_row("parts", str(len(summary.parts)), "of a rotated recording")
    if summary.commands:
        shown.add_row("commands", str(sum(summary.commands.values())), _by_whom(summary.commands))
    for problem in summary.problems:
        shown.add_row("[red]problem[/]", "", escape(problem))
    if summary.driver_error:
        shown.add_row("[red]driver[/]", "", escape(summary.driver_error))
    for trip in summary.trips:
        reason = escape(trip.reason or "")
        shown.add_row("[red]trip[/]", f"tick {trip.tick}", "; ".join(filter(None, [", ".join(trip.causes), reason])))
    out.print(shown)
    if summary.lateness_us is not None:
        _print_timing(out, summary)
    if summary.imported:
        _print_imported(out, summary)
        return
    axes = table("axis", "rms error µm", "largest drive V")
    for axis in summary.axes:
        error = "–" if axis.rms_error_um is None else f"{axis.rms_error_um:.4f}"
        axes.add_row(axis.name, error, f"{axis.max_abs_drive_v:.3f}")
    out.print(axes)


def _print_imported(out: Console, summary: Summary) -> None:
    """Signals, what they are in the other program's file, and what they range over."""
    shown = table("signal", "unit", "least", "largest", "in the file")
    shown.columns[4].justify = "left"
    mapping = (summary.imported or {})["mapping"]
    for one in summary.ranges:
        ends = ["–" if end is None else f"{end:.6g}" for end in (one.least, one.largest)]
        shown.add_row(one.name, escape(one.unit), *ends, escape(mapping.get(one.name, "")))
    out.print(shown)


def _by_whom(commands: dict[str, int]) -> str:
    """Those who asked most often, in that order."""
    most = [f"{who} {count:,}" for who, count in commands.items()]
    return escape(f"by {', '.join(most[:MOST])}{', …' * (len(most) > MOST)}")


def _print_timing(out: Console, summary: Summary) -> None:
    shown = table("µs", "p50", "p99", "p99.9", "max")
    for label, found in (("lateness", summary.lateness_us), ("tick", summary.exec_us)):
        if found is not None:
            shown.add_row(label, *(f"{found[name]:.2f}" for name in ("p50", "p99", "p999", "max")))
    out.print(shown)
    if summary.lateness_histogram:
        out.print(bars(summary.lateness_histogram, "late by µs"))
    phases = summary.phases
    labels = (("read", "read_us"), ("law", "law_us"), ("write", "write_us"))
    out.print("a tick's time, medians: " + ", ".join(f"{label} {phases[key]:.2f} µs" for label, key in labels))


def bars(histogram: list[dict[str, Any]], heading: str) -> Table:
    """Counts and shares per class, from the first class to the last that has any; a full bar is all of them."""
    shown = table(heading, "ticks", "share", "")
    shown.columns[3].justify = "left"
    counts = np.array([entry["count"] for entry in histogram])
    edges = ["0", *(f"{entry['below_us']:g}" for entry in histogram[:-1]), ""]
    some = np.flatnonzero(counts)
    for k in range(some[0], some[-1] + 1) if some.size else ():
        label = f"{edges[k]} … {edges[k + 1]}" if edges[k + 1] else f"{edges[k]} and more"
        share = counts[k] / counts.sum()
        shown.add_row(label, f"{counts[k]:,}", f"{100 * share:.3g} %", "█" * round(BAR_WIDTH * share))
    return shown


def _print_steps(prepared: Prepared, recording: str) -> None:
    """Step metrics where references were micrometres, beside what each axis's own specification asks for."""
    out, loaded = console(), load(recording)
    shown = table("steps", "overshoot %", "settling ms (5 %)", "static error %")
    driven = np.isin(loaded["mode"], (Mode.FEEDFORWARD, Mode.CLOSED_LOOP))
    for axis in prepared.configuration.axes:
        name, rate_hz = axis.name, prepared.plan.pacing.rate_hz
        metrics = step_metrics(loaded[f"{name}_reference_um"][driven], loaded[f"{name}_position_um"][driven], rate_hz)
        if metrics is None:
            continue
        shown.add_row(
            f"{name}: median of {metrics.steps}",
            figure(metrics.overshoot_percent, 2),
            figure(metrics.settling_time_ms, 2),
            figure(metrics.static_error_percent, 3),
        )
        shown.add_row(
            f"{name}: worst",
            figure(metrics.overshoot_percent_worst, 2),
            figure(metrics.settling_time_ms_worst, 2),
            figure(metrics.static_error_percent_worst, 3),
        )
        if metrics.unreached:
            shown.add_row(f"  [red]{metrics.unreached} of {metrics.steps} hardly moved, or ended more than "
                          f"{100 * SETTLING_BAND:g} % of their height from the reference[/]")  # fmt: skip
        for label, values in _asked(prepared.configuration, axis):
            shown.add_row(label, *values)
    if shown.row_count:
        out.print(shown)


def _asked(configuration: Configuration, axis: AxisOptions) -> Iterator[tuple[str, list[str]]]:
    """What the specification that an axis names asks of a step, and what it says that was claimed."""
    if axis.specification is None:
        return
    from rtloop.design.synthesis.specification_file import load_specification  # slow; no recording shown needs it

    name = escape(axis.specification)
    try:
        asked = load_specification(configuration.folder / axis.specification).design.specification
    except RtloopError as error:
        yield f"  [red]{escape(str(error))}[/]", []
        return
    limits = [getattr(asked, key) for key in STEP_QUANTITIES]
    yield f"  {name} asks", ["–" if limit is None else f"≤ {limit:g}" for limit in limits]
    if asked.claims:
        yield f"  {name} claims", [escape(asked.claim_words(key)) or "–" for key in STEP_QUANTITIES]


def print_drivers() -> None:
    """Every registered kind, as a table."""
    shown = table("kind", "moves hardware", "clock", "highest rate", "defined in")
    for found in known_drivers():
        if found["problem"]:
            shown.add_row(found["kind"], f"[red]{escape(found['problem'])}[/]", "", "", found["defined_in"])
            continue
        limit_hz = found["max_rate_hz"]
        rate = "any" if limit_hz is None else f"{limit_hz:g} Hz"
        shown.add_row(found["kind"], "yes" if found["real"] else "no", "rtloop's", rate, found["defined_in"])
    console().print(shown)


def known_drivers() -> list[dict[str, Any]]:
    """Every registered kind: what it is with its defaults, or the `problem` that keeps it from being used."""
    found = []
    for kind, where in kinds().items():
        entry = {"kind": kind, "defined_in": where, "real": None, "max_rate_hz": None, "problem": None}
        try:
            driver = driver_class(kind)
            facts = driver(driver.options_model(), {"x": driver.example}, 1000.0).facts
            limit_hz = None if facts.max_rate_hz == float("inf") else facts.max_rate_hz
            entry |= {"real": facts.real, "max_rate_hz": limit_hz}
        except (DriverError, ValueError) as error:
            entry["problem"] = str(error)
        found.append(entry)
    return found


def _size(summary: Summary) -> str:
    each = summary.bytes_per_tick
    return f"{summary.size_bytes / 2**20:.1f} MiB" + ("" if each is None else f", {each:.1f} bytes a tick")


def _scheduling(realtime: dict[str, Any]) -> str:
    memory = "memory locked" if realtime.get("mlock") else "memory not locked"
    return f"{realtime.get('scheduler')} {realtime.get('priority') or ''}, {memory}".replace(" ,", ",")

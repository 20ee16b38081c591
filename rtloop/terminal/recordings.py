"""What the terminal shows of a recording: verdict of a replay, another law beside it, what was recovered."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from rtloop.recording.replay.replay import ReplayReport
from rtloop.terminal.table import console, table
from rtloop.values import count_text

METRICS = (
    ("rms_error_um", "rms error µm"),
    ("max_abs_error_um", "largest error µm"),
    ("max_abs_drive_v", "largest drive V"),
)
STEP_METRICS = (
    ("overshoot_percent", "overshoot %, median"),
    ("overshoot_percent_worst", "overshoot %, worst"),
    ("settling_time_ms", "settling ms (5 %), median"),
    ("settling_time_ms_worst", "settling ms (5 %), worst"),
    ("static_error_percent", "static error %, median"),
)


def print_replay(path: Path, report: ReplayReport) -> None:
    """The verdict, the gaps, what is not verified and what cannot be, the first difference."""
    out = console()
    for gap in report.gaps:
        out.print(f"gap: {count_text(gap['count'], 'tick')} from tick {gap['first_tick']} on, missing in the recording")
    _print_problems(out, report.problems)
    for entry in report.not_verified:
        out.print(f"[red]not verified[/]: {_range(entry)}{escape(entry['why'])}")
    out.print(f"not judged: {'; '.join(report.not_judged)}")
    checked = f"{count_text(report.ticks, 'tick')} and {count_text(report.snapshots, 'snapshot')} of the law's state"
    if report.skipped:
        stretches = count_text(report.stretches, "stretch", "stretches")
        checked += f" in {stretches}"
        out.print(f"left out by intention: {count_text(report.skipped, 'tick')} beside {stretches}")
    name, found = _name(path), report.first_difference
    if report.identical:
        out.print(f"[green]identical[/]: {name}: {checked} compared in bytes")
    elif found is None:
        out.print(f"[red]not verified as a whole[/]: {name}: no difference in {checked} compared in bytes")
    else:
        values = f"recorded {found['recorded']!r}, replayed {found['replayed']!r}"
        out.print(f"[red]different[/]: {name}: tick {found['tick']}, {found['signal']}: {values} ({checked} compared)")


def _range(entry: dict[str, Any]) -> str:
    """Which ticks are not verified, as far as they are known."""
    first, count = entry["first_tick"], entry["count"]
    if first is None:
        return ""
    return f"ticks from {first} on: " if count is None else f"{count_text(count, 'tick')} from tick {first} on: "


def print_differences(report: dict[str, Any]) -> None:
    """Largest and root mean square difference, signal by signal."""
    out = console()
    law, recording = _name(report["config"]), _name(report["recording"])
    out.print(f"the law of {law} on the inputs of {recording}: {count_text(report['ticks'], 'tick')}")
    shown = table("difference", "largest", "at tick", "rms")
    for name, difference in report["signals"].items():
        shown.add_row(name, f"{difference['max']:.6g}", str(difference["at_tick"]), f"{difference['rms']:.6g}")
    out.print(shown)
    _print_trip(out, "it would have tripped", report["trip"])
    _print_problems(out, report["problems"])


def print_resimulation(report: dict[str, Any]) -> None:
    """Recorded and resimulated, side by side."""
    out = console()
    law = report["config"] or "the recorded law and rig"
    out.print(
        f"the reference of {_name(report['recording'])} through {_name(law)}: {count_text(report['ticks'], 'tick')}"
    )
    for axis in report["axes"]:
        before, after = axis["recorded"], axis["resimulated"]
        shown = table(f"axis {axis['name']}", "recorded", "resimulated")
        for key, label in METRICS:
            shown.add_row(label, _number(before[key]), _number(after[key]))
        if before["steps"] and after["steps"]:
            for key, label in STEP_METRICS:
                shown.add_row(label, _number(before["steps"][key]), _number(after["steps"][key]))
        out.print(shown)
    for name, trip in report["trips"].items():
        _print_trip(out, f"{name}: tripped", trip)
    _print_problems(out, report["problems"])


def print_recovery(report: dict[str, Any]) -> None:
    """What is in the recovered file, and what is missing."""
    out = console()
    original, whole = _name(report["recording"]), report["complete"] and not report["gaps"] and not report["problems"]
    if whole:
        out.print(f"{original} is whole, there was nothing to recover; {_name(report['output'])} is a copy")
        return
    out.print(f"{_name(report['output'])}: {count_text(report['ticks'], 'tick')} recovered from {original}")
    for first, count in report["gaps"]:
        out.print(f"missing: {count_text(count, 'tick')} from tick {first} on")
    _print_problems(out, report["problems"])
    if not report["complete"]:
        out.print("the end of the run is not in it: what came after its last tick is not known")


def print_cut(report: dict[str, Any]) -> None:
    """What stretch is in which file, and what of it is missing."""
    out = console()
    span = f"{report['first']} to {report['end'] - 1}"
    if report["begin"] < report["first"]:
        span += f", and what leads to them from tick {report['begin']} on"
    ticks = count_text(report["ticks"], "tick")
    out.print(f"{_name(report['output'])}: {ticks} of {_name(report['recording'])}: {span}")
    for first, count in report["gaps"]:
        out.print(f"missing: {count_text(count, 'tick')} from tick {first} on")
    _print_problems(out, report["problems"])


def print_export(report: dict[str, Any]) -> None:
    """What was written where."""
    out = console()
    out.print(f"{_name(report['output'])}: {count_text(report['ticks'], 'tick')}, {report['bytes'] / 2**20:.1f} MiB")
    _print_problems(out, report["problems"])


def _print_trip(out: Console, what: str, trip: dict[str, Any] | None) -> None:
    if trip:
        out.print(f"[red]{what}[/] at tick {trip['tick']}: {', '.join(trip['causes'])}")


def _print_problems(out: Console, problems: list[str]) -> None:
    for problem in problems:
        out.print(f"[red]problem[/]: {_name(problem)}")


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def _name(text: object) -> str:
    """As it is: brackets in the name of a file are no markup."""
    return escape(str(text))

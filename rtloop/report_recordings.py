"""What the terminal shows of a recording: verdict of a replay, another law beside it, what was recovered."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from rtloop.recording.replay import ReplayReport
from rtloop.terminal import console as _console
from rtloop.terminal import table as _table

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
    """The verdict, the gaps, the first difference."""
    console = _console()
    for gap in report.gaps:
        console.print(f"gap: {gap['count']} ticks from tick {gap['first_tick']} on are not in the recording")
    _print_problems(console, report.problems)
    if report.unverified:
        console.print(f"{report.unverified:,} ticks before the next snapshot of the law were passed over")
    checked = f"{report.ticks:,} ticks and {report.snapshots} snapshots of the law's state"
    if report.first_difference is None:
        console.print(f"[green]identical[/]: {_name(path)}: {checked} compared in bytes")
        return
    found = report.first_difference
    console.print(
        f"[red]different[/]: {_name(path)}: tick {found['tick']}, {found['signal']}: recorded {found['recorded']!r}, "
        f"replayed {found['replayed']!r} ({checked} compared)"
    )


def print_differences(report: dict[str, Any]) -> None:
    """Largest and root mean square difference, signal by signal."""
    console = _console()
    law, recording = _name(report["config"]), _name(report["recording"])
    console.print(f"the law of {law} on the inputs of {recording}: {report['ticks']:,} ticks")
    table = _table("difference", "largest", "at tick", "rms")
    for name, difference in report["signals"].items():
        table.add_row(name, f"{difference['max']:.6g}", str(difference["at_tick"]), f"{difference['rms']:.6g}")
    console.print(table)
    _print_trip(console, "it would have tripped", report["trip"])
    _print_problems(console, report["problems"])


def print_resimulation(report: dict[str, Any]) -> None:
    """Recorded and resimulated, side by side."""
    console = _console()
    law = report["config"] or "the recorded law and rig"
    console.print(f"the reference of {_name(report['recording'])} through {_name(law)}: {report['ticks']:,} ticks")
    for axis in report["axes"]:
        before, after = axis["recorded"], axis["resimulated"]
        table = _table(f"axis {axis['name']}", "recorded", "resimulated")
        for key, label in METRICS:
            table.add_row(label, _number(before[key]), _number(after[key]))
        if before["steps"] and after["steps"]:
            for key, label in STEP_METRICS:
                table.add_row(label, _number(before["steps"][key]), _number(after["steps"][key]))
        console.print(table)
    for name, trip in report["trips"].items():
        _print_trip(console, f"{name}: tripped", trip)
    _print_problems(console, report["problems"])


def print_recovery(report: dict[str, Any]) -> None:
    """What is in the recovered file, and what is missing."""
    console = _console()
    console.print(f"{_name(report['output'])}: {report['ticks']:,} ticks recovered from {_name(report['recording'])}")
    for first, count in report["gaps"]:
        console.print(f"missing: {count:,} ticks from tick {first} on")
    _print_problems(console, report["problems"])
    if not report["complete"]:
        console.print("the end of the run is not in it: what came after its last tick is not known")


def print_export(report: dict[str, Any]) -> None:
    """What was written where."""
    console = _console()
    console.print(f"{_name(report['output'])}: {report['ticks']:,} ticks, {report['bytes'] / 2**20:.1f} MiB")
    _print_problems(console, report["problems"])


def _print_trip(console: Console, what: str, trip: dict[str, Any] | None) -> None:
    if trip:
        console.print(f"[red]{what}[/] at tick {trip['tick']}: {', '.join(trip['causes'])}")


def _print_problems(console: Console, problems: list[str]) -> None:
    for problem in problems:
        console.print(f"[red]problem[/]: {_name(problem)}")


def _name(text: object) -> str:
    """As it is: brackets in the name of a file are no markup."""
    return escape(str(text))


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"

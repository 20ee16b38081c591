"""Result of a replay, and of another law on a recording, as text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.values import count_text
from rtloop.workbench.tables import escape, format_number, print_problems, table

if TYPE_CHECKING:
    from rich.console import Console

    from rtloop.recording.replay.verdict import ReplayReport
    from rtloop.signals import Trip

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


def print_replay(out: Console, path: Path, report: ReplayReport) -> None:
    """Print gaps, problems, ticks that are not verified, the verdict, and contents that no replay can judge."""
    for gap in report.gaps:
        out.print(f"gap: the recording lacks {count_text(gap['count'], 'tick')} from tick {gap['first_tick']} on")
    print_problems(out, report.problems)
    for entry in report.not_verified:
        out.print(f"[red]not verified[/]: {_range_text(entry)}{escape(entry['why'])}")
    extent = f"{count_text(report.ticks, 'tick')} and {count_text(report.snapshots, 'snapshot')} of the law's state"
    if report.skipped:
        stretches = count_text(report.stretches, "stretch", "stretches")
        extent += f" in {stretches}"
        out.print(
            f"not recorded, as configured: {count_text(report.skipped, 'tick')} outside {stretches} around events"
        )
    name, difference = escape(path), report.first_difference
    if report.identical:
        out.print(f"[green]identical[/]: {name}: {extent} compared byte by byte")
    elif difference is None:
        out.print(f"[red]not verified as a whole[/]: {name}: no difference in {extent}, compared byte by byte")
    else:
        place = f"tick {difference['tick']}, {difference['signal']}"
        if (difference["recorded"], difference["replayed"]) != (None, None):
            place += f": recorded {difference['recorded']!r}, replayed {difference['replayed']!r}"
        out.print(f"[red]different[/]: {name}: {place} ({extent} compared)")
    subjects = [re.split("[:,(]", entry)[0] for entry in report.not_judged[:2]]
    out.print(f"not judged: {', '.join(subjects)}, and {len(report.not_judged) - 2} other contents that --json lists")


def _range_text(entry: dict[str, Any]) -> str:
    """Return the ticks of an entry of `not_verified` in words, with a colon; "" where they are unknown."""
    first, count = entry["first_tick"], entry["count"]
    if first is None:
        return ""
    return f"ticks from {first} on: " if count is None else f"{count_text(count, 'tick')} from tick {first} on: "


def print_differences(out: Console, report: dict[str, Any]) -> None:
    """Print the largest and the root mean square difference of each signal, the law's trip, and problems.

    `report` is the dict of `replay_with_other_law`.
    """
    law, recording = escape(report["config"]), escape(report["recording"])
    out.print(f"the law of {law}, run on the inputs of {recording}: {count_text(report['ticks'], 'tick')}")
    rows = table("difference", "largest", "at tick", "rms")
    for name, difference in report["signals"].items():
        rows.add_row(name, f"{difference['max']:.6g}", str(difference["at_tick"]), f"{difference['rms']:.6g}")
    out.print(rows)
    _print_trip(out, "this law would have tripped", report["trip"])
    print_problems(out, report["problems"])


def print_resimulation(out: Console, report: dict[str, Any]) -> None:
    """Print figures of the recorded and the resimulated run side by side, their first trips, and problems.

    `report` is the dict of `replay_on_the_rig`.
    """
    law = report["config"] or "the recorded law and rig"
    reference = f"the reference of {escape(report['recording'])}"
    out.print(f"{reference} through {escape(law)}: {count_text(report['ticks'], 'tick')}")
    for axis in report["axes"]:
        before, after = axis["recorded"], axis["resimulated"]
        rows = [(label, before[key], after[key]) for key, label in METRICS]
        if before["steps"] and after["steps"]:
            rows += [(label, before["steps"][key], after["steps"][key]) for key, label in STEP_METRICS]
        cells = [(label, *(format_number(value, ".4f") for value in values)) for label, *values in rows]
        out.print(table(f"axis {axis['name']}", "recorded", "resimulated", rows=cells))
    for name, trip in report["trips"].items():
        _print_trip(out, f"{name}: tripped", trip)
    print_problems(out, report["problems"])


def _print_trip(out: Console, label: str, trip: Trip | None) -> None:
    """Print the tick and the causes of a trip; no line for None."""
    if trip:
        out.print(f"[red]{label}[/] at tick {trip['tick']}: {', '.join(trip['causes'])}")

"""`rtloop replay`: a recording executed again, with the recorded law or with another configuration's law or rig."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import FILES, JSON, OUTPUT
from rtloop.cli.output import print_result
from rtloop.cli.output.progress import Counter
from rtloop.cli.output.tables import console, escape, format_number, print_problems, table
from rtloop.errors import ConfigError
from rtloop.values import count_text

if TYPE_CHECKING:
    from rich.console import Console

    from rtloop.configuration.file import Configuration
    from rtloop.configuration.laws import Library
    from rtloop.drivers.base import Driver
    from rtloop.recording.load import Recording
    from rtloop.recording.replay.law_comparison import LawWithCoefficients
    from rtloop.recording.replay.laws import TrustedLaws
    from rtloop.recording.replay.replay import ReplayReport


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


@click.command()
@FILES
@click.option("--config", type=OUTPUT, help="Run the law of this configuration on the recorded inputs.")
@click.option("--resimulate", is_flag=True, help="Run the recorded reference in closed loop with the simulated rig.")
@click.option("--law", "laws", type=OUTPUT, multiple=True, help="File with a recorded law that is not installed here.")
@click.option(
    "--trust-recorded-law", is_flag=True, help="Run the code of the laws in the recording, if you trust its source."
)
@click.option(
    "--jobs", type=click.IntRange(min=1), help="Processes that replay at once.  [default: one for each processor]"
)
@JSON
@report_errors
def replay(
    files: tuple[Path, ...],
    config: Path | None,
    resimulate: bool,
    laws: tuple[Path, ...],
    trust_recorded_law: bool,
    jobs: int | None,
    as_json: bool,
) -> int:
    """Execute a recording again and compare its outputs.

    Compares every output of every tick, byte by byte; exit 1 where one differs.

    With --config: computes the commands of another law on the same inputs, from rest. With --resimulate: runs the
    recorded reference in closed loop on a simulated rig; law and rig are those of --config, or the recorded ones
    without it. Both run in one process, since each tick follows from the one before, and end with exit code 0.
    """
    from rtloop.recording.load import load
    from rtloop.recording.replay.spans import replay_on_cores

    trust = make_trust(laws, trust_recorded_law)
    with Counter("ticks replayed", sys.stderr) as counter:
        if resimulate:
            print_result(replay_on_the_rig(files, config, counter.show, trust), as_json, _print_resimulation)
            return 0
        if config is not None:
            print_result(replay_with_other_law(files, config, counter.show), as_json, _print_differences)
            return 0
        report = replay_on_cores(load(files), counter.show, trust, jobs or len(os.sched_getaffinity(0)))
    print_result(report.as_dict(), as_json, lambda _: _print_replay(files[0], report))
    return 0 if report.identical else 1


def replay_with_other_law(
    files: Sequence[Path], config: Path, progress: Callable[[int], None] | None = None
) -> dict[str, Any]:
    """Compare the recorded outputs with the outputs of the law in `config` on the recorded inputs.

    Returns {recording, config, ticks, problems, signals: {name: {max, at_tick, rms}}, trip}; `trip` is {tick, causes}
    of the first trip of the law, or None. `progress` receives the number of ticks so far. Raises RecordingError,
    ConfigError for an invalid file or other axes.
    """
    from rtloop.configuration.file import load
    from rtloop.recording.replay.law_comparison import compare_law

    recording = _load_recording(files)
    differences = compare_law(recording, _configured_law(load(config), recording), progress)
    return {"recording": str(recording.paths[0]), "config": str(config), **differences}


def replay_on_the_rig(
    files: Sequence[Path],
    config: Path | None,
    progress: Callable[[int], None] | None = None,
    trust: TrustedLaws | None = None,
) -> dict[str, Any]:
    """Run the recorded reference through law and simulated rig of `config`, or the recorded ones for None.

    Returns {recording, config, ticks, problems, trips, axes}: `axes` has tracking figures of the recorded and the
    resimulated run, `trips` their first trips {tick, causes} or None. `progress` receives the number of ticks so far.
    `trust` names recorded laws that may run; None: none. Raises RecordingError, also for a recorded law that is not
    trusted, ConfigError for an invalid configuration or one without the simulated rig.
    """
    from rtloop.configuration.file import load, parse
    from rtloop.recording.replay.law_comparison import recorded_law, resimulate
    from rtloop.recording.replay.laws import NO_TRUST

    recording, trust = _load_recording(files), trust or NO_TRUST
    path = recording.paths[0]
    if config is None:
        library = _recorded_library(recording, trust)
        source = f"configuration in {path}"
        configuration = parse(recording.configuration, path.stem, path.parent, source, library)
        driver, law = _make_rig(configuration, recording), recorded_law(recording, trust)
    else:
        configuration = load(config)
        driver, law = _make_rig(configuration, recording), _configured_law(configuration, recording)
    figures = resimulate(recording, law, driver, progress)
    return {"recording": str(path), "config": None if config is None else str(config), **figures}


def make_trust(files: Sequence[Path], trusts_recorded: bool) -> TrustedLaws:
    """Return the laws whose code a replay may run: those in `files`, with `trusts_recorded` also the recorded ones.

    The files run first in the limited process, which is killed if a law does not return. Raises InputFileError for an
    unreadable file, RecordingError for one without a valid law, ConfigError for a law that does not end or ends the
    process.
    """
    from rtloop.configuration.text_files import read_text
    from rtloop.laws.limited.trial import try_limited
    from rtloop.laws.registry import laws_in
    from rtloop.recording.errors import RecordingError
    from rtloop.recording.replay.laws import TrustedLaws

    texts = {str(path): read_text(path) for path in files}
    for file, text in texts.items():
        try_limited(file, laws_in, text, file)
    try:
        laws = [law for file, text in texts.items() for law in laws_in(text, file)]
    except ValueError as error:
        raise RecordingError(str(error)) from None
    return TrustedLaws(tuple(laws), trusts_recorded)


def _load_recording(files: Sequence[Path]) -> Recording:
    """Load a recording. Raises RecordingError if it is unreadable, or has no law, as an import."""
    from rtloop.recording.load import load
    from rtloop.recording.replay.laws import require_law

    recording = load(files)
    require_law(recording)
    return recording


def _recorded_library(recording: Recording, trust: TrustedLaws) -> Library:
    """Return a library of the recorded laws, under the file names in the configuration.

    Raises RecordingError for a law that is neither installed nor trusted.
    """
    from rtloop.configuration.laws import Library
    from rtloop.recording.replay.laws import recorded_laws

    laws = recorded_laws(recording, trust)
    files = {law["name"]: str(law["file"]) for law in recording.header["law"].get("laws", ()) if "file" in law}
    folder = Path(str(recording.header.get("folder", "")))
    return Library(folder, tuple(replace(law, file=files.get(law.kind, law.file)) for law in laws))


def _configured_law(configuration: Configuration, recording: Recording) -> LawWithCoefficients:
    """Return the law of a configuration. Raises ConfigError if its axes or rate differ from the recording's."""
    import numpy as np

    from rtloop.configuration.prepare import prepare
    from rtloop.recording.replay.law_comparison import LawWithCoefficients

    header, faults = recording.header, []
    names = [axis.name for axis in configuration.axes]
    if names != header["axes"]:
        faults.append(f"axis: {', '.join(names)}; allowed: the recording's axes, {', '.join(header['axes'])}")
    if configuration.loop.rate_hz != header["rate_hz"]:
        faults.append(
            f"loop.rate_hz: {configuration.loop.rate_hz:g} Hz; allowed: the recording's rate, {header['rate_hz']:g} Hz"
        )
    if faults:
        raise ConfigError(configuration.source, faults)
    plan = prepare(replace(configuration, schedule=())).plan
    return LawWithCoefficients(plan.laws, plan.coefficients.view(np.recarray))


def _make_rig(configuration: Configuration, recording: Recording) -> Driver:
    """Return the simulated rig of a configuration, not opened, at the recording's rate.

    Raises ConfigError for a driver of another kind and for invalid options.
    """
    from rtloop.drivers.registry import driver_class

    if configuration.driver_kind != "sim":
        fault = f"driver.kind: {configuration.driver_kind!r}; allowed with --resimulate: 'sim', the simulated rig"
        raise ConfigError(configuration.source, [fault])
    try:
        kind = driver_class(configuration.driver_kind)
        return kind(configuration.driver_options, configuration.wiring, recording.header["rate_hz"])
    except ValueError as error:
        raise ConfigError(configuration.source, [f"driver.{error}"]) from None


def _print_replay(path: Path, report: ReplayReport) -> None:
    """Print gaps, problems, ticks that are not verified, the verdict, and signals that are not judged."""
    out = console()
    for gap in report.gaps:
        out.print(f"gap: {count_text(gap['count'], 'tick')} from tick {gap['first_tick']} on, missing in the recording")
    print_problems(out, report.problems)
    for entry in report.not_verified:
        out.print(f"[red]not verified[/]: {_range_text(entry)}{escape(entry['why'])}")
    extent = f"{count_text(report.ticks, 'tick')} and {count_text(report.snapshots, 'snapshot')} of the law's state"
    if report.skipped:
        stretches = count_text(report.stretches, "stretch", "stretches")
        extent += f" in {stretches}"
        out.print(f"left out by intention: {count_text(report.skipped, 'tick')} outside the {stretches}")
    name, difference = escape(path), report.first_difference
    if report.identical:
        out.print(f"[green]identical[/]: {name}: {extent} compared in bytes")
    elif difference is None:
        out.print(f"[red]not verified as a whole[/]: {name}: no difference in {extent} compared in bytes")
    else:
        values = f"recorded {difference['recorded']!r}, replayed {difference['replayed']!r}"
        place = f"tick {difference['tick']}, {difference['signal']}"
        out.print(f"[red]different[/]: {name}: {place}: {values} ({extent} compared)")
    out.print(f"not judged: {'; '.join(report.not_judged)}")


def _range_text(entry: dict[str, Any]) -> str:
    """Return the ticks of an entry of `not_verified` in words, with a colon; "" where they are unknown."""
    first, count = entry["first_tick"], entry["count"]
    if first is None:
        return ""
    return f"ticks from {first} on: " if count is None else f"{count_text(count, 'tick')} from tick {first} on: "


def _print_differences(report: dict[str, Any]) -> None:
    """Print the largest and the root mean square difference of each signal."""
    out = console()
    law, recording = escape(report["config"]), escape(report["recording"])
    out.print(f"the law of {law} on the inputs of {recording}: {count_text(report['ticks'], 'tick')}")
    rows = table("difference", "largest", "at tick", "rms")
    for name, difference in report["signals"].items():
        rows.add_row(name, f"{difference['max']:.6g}", str(difference["at_tick"]), f"{difference['rms']:.6g}")
    out.print(rows)
    _print_trip(out, "this law would have tripped", report["trip"])
    print_problems(out, report["problems"])


def _print_resimulation(report: dict[str, Any]) -> None:
    """Print figures of the recorded and the resimulated run side by side."""
    out = console()
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


def _print_trip(out: Console, label: str, trip: dict[str, Any] | None) -> None:
    """Print the tick and the causes of a trip; no line for None."""
    if trip:
        out.print(f"[red]{label}[/] at tick {trip['tick']}: {', '.join(trip['causes'])}")

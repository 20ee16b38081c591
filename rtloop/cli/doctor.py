"""`rtloop doctor`: the host judged for a loop, in the terminal, as JSON and as a picture."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT, TARGET, Seconds
from rtloop.cli.output import echo_json
from rtloop.cli.output.progress import StatusLine
from rtloop.values import to_jsonable
from rtloop.workbench.summary_text import histogram_table
from rtloop.workbench.tables import console, escape, table

if TYPE_CHECKING:
    from rtloop.doctor.examine import Examination, Latency
    from rtloop.doctor.node_line import NetworkLine, SerialLine
    from rtloop.doctor.remedy import SettingWrite
    from rtloop.doctor.verdict import AxisDelay
    from rtloop.engine.plan import Pacing


MARKS = {True: "[green]good[/]", False: "[red]BAD[/]", None: "[dim]?[/]"}
DEFAULT_RATE_HZ = 10_000.0


@click.command()
@click.argument("config", type=OUTPUT, required=False)
@click.option(
    "--seconds", type=Seconds(), default=5.0, show_default=True, help="Time for which the loop's clock is measured."
)
@click.option(
    "--apply",
    "change",
    is_flag=True,
    help="Change the settings that can be changed without a restart of the host; needs root.",
)
@click.option("--png", type=TARGET, metavar="FILE", help="Picture to write: histogram of the ticks' lateness.")
@JSON
@report_errors
def doctor(config: Path | None, seconds: float, change: bool, png: Path | None, as_json: bool) -> int:
    """Judge this host for the loop of CONFIG, or for 10 kHz.

    Exit 1 where the host is not suitable.

    Checks the conditions that make ticks late, and states the cost of each and the command that corrects it. Measures
    the lateness of the loop's own clock, and compares it with the loop's period and margins. With CONFIG, stores the
    lateness, which `rtloop check` compares with the delay margin. Touches no hardware; changes settings only with
    --apply.
    """
    from rtloop.configuration.file import load
    from rtloop.configuration.prepare import prepare
    from rtloop.doctor.node_line import find_line
    from rtloop.doctor.remedy import apply_remedies
    from rtloop.doctor.verdict import axis_delays, reasons_unsuitable
    from rtloop.engine.plan import Pacing
    from rtloop.supervision.host_delay import store_host_delay

    prepared = None if config is None else prepare(load(config))
    pacing = Pacing(DEFAULT_RATE_HZ) if prepared is None else prepared.plan.pacing
    line = None if prepared is None else find_line(prepared.configuration)
    examination, writes = _examine(pacing, seconds, line), []
    if change:
        writes = apply_remedies(examination.findings)
        examination = _examine(pacing, seconds, line)
    delays = []
    if prepared is not None:
        store_host_delay(prepared.configuration, lateness_us=examination.latency.quantile_us(0.99))
        delays = axis_delays(prepared, examination.latency)
    objections = reasons_unsuitable(examination, delays)
    if png is not None:
        from rtloop.doctor.histogram import draw_histogram

        draw_histogram(examination.latency, png)
    if as_json:
        echo_json(_report(examination, delays, objections, writes))
    else:
        name = "a loop" if prepared is None else prepared.plan.name
        _print_examination(name, examination, delays, objections, writes)
    return 1 if objections else 0


def _examine(pacing: Pacing, seconds: float, line: NetworkLine | SerialLine | None) -> Examination:
    """Measure the loop's clock for `seconds`, check the host, and the `line` to a node unless it is None.

    Returns the Examination. A status line is shown meanwhile.
    """
    from rtloop.doctor.examine import examine

    with StatusLine(f"the loop's clock runs for {seconds:g} s at {pacing.rate_hz:g} Hz", sys.stderr):
        return examine(pacing, seconds, line=line)


def _print_examination(
    name: str,
    examination: Examination,
    delays: list[AxisDelay],
    objections: list[str],
    writes: list[SettingWrite],
) -> None:
    """Print settings that were written, findings, lateness, its phase for each axis, and the verdict for loop `name`.

    `objections` are the reasons why the host is not suitable; it is suitable if there are none.
    """
    out, latency = console(), examination.latency
    for write in writes:
        outcome = (
            f"[red]refused, {escape(write.refused)}[/]"
            if write.refused
            else "done; lasts until the next restart of the host"
        )
        out.print(f"{write.condition}: write {escape(repr(write.text))} to {write.path}: {outcome}")
    rows = table("", "condition", "found", "wanted", words=(1, 2, 3))
    for finding in examination.findings:
        rows.add_row(MARKS[finding.good], finding.condition, escape(finding.value), finding.wanted)
    out.print(rows)
    bad_findings = sorted((f for f in examination.findings if f.good is False), key=lambda f: -f.late_us)
    if bad_findings:
        out.print("\n[bold]bad conditions and the delay that each may cost, the largest first[/]")
    for finding in bad_findings:
        delay = f", up to {_format_time(finding.late_us)}" if finding.late_us else ""
        out.print(f"{finding.condition}{delay}: {escape(finding.consequence)}")
        out.print(f"    {escape(finding.fix)}")
    _print_latency(latency)
    for delay in delays:
        out.print(
            f"axis {delay.axis}: at the crossover with the least delay margin, {delay.crossover_hz:.0f} Hz, the "
            f"lateness costs {delay.p50_deg:.2f}° of phase (p50), {delay.p99_deg:.2f}° (p99); the loop tolerates a "
            f"delay of {_format_time(delay.tolerated_us)}"
        )
    loop = f"suitable for {name} at {latency.pacing.rate_hz / 1000:g} kHz"
    if objections:
        out.print(f"\n[bold red]not {loop}[/] (period {_format_time(latency.period_us)}), because:")
        for reason in objections:
            out.print(f"  {escape(reason)}")
    else:
        out.print(f"\n[bold green]{loop}[/]")


def _print_latency(latency: Latency) -> None:
    """Print quantiles in µs, missed periods, stolen time and the histogram of the lateness of the loop's own clock."""
    pacing, out = latency.pacing, console()
    p50_us, p99_us, p999_us, max_us = latency.quantiles_us.values()
    quantiles = f"p50 {p50_us:.2f}, p99 {p99_us:.2f}, p99.9 {p999_us:.2f}, max {max_us:.2f}"
    spin = (
        f"busy-waiting for the last {pacing.spin_us:g} µs of a period" if pacing.spin_us else "sleeping between ticks"
    )
    seconds = latency.lateness_us.size / pacing.rate_hz
    out.print(
        f"\n[bold]the loop's clock[/], {seconds:g} s at {pacing.rate_hz:g} Hz, {spin}: late by {quantiles} µs; "
        f"{int(latency.missed.sum())} periods missed; a hypervisor took {latency.stolen_s:.2f} s of processor time"
    )
    out.print(histogram_table(_histogram_classes(latency), "late by µs"))


def _histogram_classes(latency: Latency) -> Sequence[Mapping[str, float | None]]:
    """Return the number of ticks in each class of lateness, [{below_us, count}, …], ascending by the upper limit, which
    is None for the last class.
    """
    from rtloop.recording.views.histogram import TimeHistogram

    histogram = TimeHistogram()
    histogram.add(latency.lateness_us)
    return histogram.class_counts()


def _format_time(time_us: float) -> str:
    """Return a time as text, in µs below 1 ms, else in ms."""
    return f"{time_us / 1000:.3g} ms" if time_us >= 1000 else f"{time_us:.3g} µs"


def _report(
    examination: Examination, delays: list[AxisDelay], objections: list[str], writes: list[SettingWrite]
) -> dict[str, object]:
    """Return the JSON report of an examination, as `rtloop doctor --json` prints it.

    `objections` are the reasons why the host is not suitable. Keys: suitable, reasons, rate_hz, spin_us, findings,
    lateness_us (quantiles), lateness_histogram, ticks, periods_missed, late_share (0 … 1), stolen_s, axes, applied
    (`writes`) and versions.
    """
    from rtloop.doctor.software import library_versions

    latency = examination.latency
    return to_jsonable(
        {
            "suitable": not objections,
            "reasons": objections,
            "rate_hz": latency.pacing.rate_hz,
            "spin_us": latency.pacing.spin_us,
            "findings": [asdict(finding) for finding in examination.findings],
            "lateness_us": latency.quantiles_us,
            "lateness_histogram": _histogram_classes(latency),
            "ticks": latency.lateness_us.size,
            "periods_missed": int(latency.missed.sum()),
            "late_share": latency.late_share,
            "stolen_s": latency.stolen_s,
            "axes": [asdict(delay) for delay in delays],
            "applied": [write._asdict() for write in writes],
            "versions": library_versions(),
        }
    )

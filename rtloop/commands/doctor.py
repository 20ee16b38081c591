"""`rtloop doctor`: the host judged for a loop, in the terminal, as JSON and as a picture."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.markup import escape

from rtloop.configuration.file import load
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.doctor.examine import Examination, Latency, examine
from rtloop.doctor.remedy import Write, apply
from rtloop.doctor.software import versions
from rtloop.doctor.verdict import AxisDelay, axis_delays, reasons
from rtloop.engine.plan import Pacing
from rtloop.recording.views.histogram import TimeHistogram
from rtloop.supervision.host_delay import store_host_delay
from rtloop.terminal.machine import echo_json
from rtloop.terminal.progress import StatusLine
from rtloop.terminal.run import bars
from rtloop.terminal.table import console, table
from rtloop.values import to_jsonable

MARKS = {True: "[green]good[/]", False: "[red]BAD[/]", None: "[dim]?[/]"}
DEFAULT_RATE_HZ = 10_000.0


def doctor_host(config: Path | None, seconds: float, change: bool, png: Path | None, as_json: bool) -> int:
    """Examine, change settings where asked to, judge. 0 where the host suits the loop, 1 where it does not."""
    prepared = None if config is None else prepare(load(config))
    pacing = Pacing(DEFAULT_RATE_HZ) if prepared is None else prepared.plan.pacing
    examination = _examined(pacing, seconds)
    writes: list[Write] = []
    if change:
        writes = apply(examination.findings)
        examination = _examined(pacing, seconds)
    if prepared is not None:
        store_host_delay(prepared.configuration, lateness_us=examination.latency.quantile_us(0.99))
    delays = [] if prepared is None else axis_delays(prepared, examination.latency)
    found = reasons(examination, delays)
    if png is not None:
        from rtloop.doctor.picture import draw

        draw(examination.latency, png)
    if as_json:
        echo_json(_report(examination, delays, found, writes))
    else:
        _print(prepared, examination, delays, found, writes)
    return 1 if found else 0


def _examined(pacing: Pacing, seconds: float) -> Examination:
    with StatusLine(f"the loop's clock runs for {seconds:g} s at {pacing.rate_hz:g} Hz", sys.stderr):
        return examine(pacing, seconds)


def _print(
    prepared: Prepared | None,
    examination: Examination,
    delays: list[AxisDelay],
    found: list[str],
    writes: list[Write],
) -> None:
    out, latency = console(), examination.latency
    for write in writes:
        outcome = f"[red]refused: {escape(write.refused)}[/]" if write.refused else "written, until the next restart"
        out.print(f"{write.condition}: {escape(repr(write.text))} > {write.path}: {outcome}")
    rows = table("", "condition", "found", "wanted")
    for column in rows.columns:
        column.justify = "left"
    for finding in examination.findings:
        rows.add_row(MARKS[finding.good], finding.condition, escape(finding.value), finding.wanted)
    out.print(rows)
    bad = sorted((f for f in examination.findings if f.good is False), key=lambda f: -f.late_us)
    if bad:
        out.print("\n[bold]what is bad costs, the worst first[/]")
    for finding in bad:
        out.print(f"{finding.condition}, up to {_time(finding.late_us)}: {escape(finding.consequence)}")
        out.print(f"    {escape(finding.fix)}")
    _print_latency(latency)
    for delay in delays:
        out.print(
            f"axis {delay.axis}: at its tightest crossover, {delay.crossover_hz:.0f} Hz, the lateness costs "
            f"{delay.p50_deg:.2f}° of phase (p50), {delay.p99_deg:.2f}° (p99); it bears {_time(delay.tolerated_us)}"
        )
    what = "a loop" if prepared is None else prepared.plan.name
    rate = f"{latency.pacing.rate_hz / 1000:g} kHz"
    if found:
        out.print(f"\n[bold red]not suitable for {what} at {rate}[/], whose period is {_time(latency.period_us)}:")
        for reason in found:
            out.print(f"  {escape(reason)}")
    else:
        out.print(f"\n[bold green]suitable for {what} at {rate}[/]")


def _print_latency(latency: Latency) -> None:
    pacing, out = latency.pacing, console()
    p50_us, p99_us, p999_us, max_us = latency.quantiles_us.values()
    quantiles = f"p50 {p50_us:.2f}, p99 {p99_us:.2f}, p99.9 {p999_us:.2f}, max {max_us:.2f}"
    spin = f"the last {pacing.spin_us:g} µs spinning" if pacing.spin_us else "sleeping"
    seconds = latency.lateness_us.size / pacing.rate_hz
    out.print(
        f"\n[bold]the loop's clock[/], {seconds:g} s at {pacing.rate_hz:g} Hz, {spin}: late by {quantiles} µs; "
        f"{int(latency.missed.sum())} periods missed; {latency.stolen_s:.2f} s stolen by a hypervisor"
    )
    out.print(bars(_classes(latency), "late by µs"))


def _classes(latency: Latency) -> list[dict[str, Any]]:
    histogram = TimeHistogram()
    histogram.add(latency.lateness_us)
    return histogram.class_counts()


def _time(us: float) -> str:
    return f"{us / 1000:.3g} ms" if us >= 1000 else f"{us:.3g} µs"


def _report(examination: Examination, delays: list[AxisDelay], found: list[str], writes: list[Write]) -> dict[str, Any]:
    latency = examination.latency
    return to_jsonable(
        {
            "suitable": not found,
            "reasons": found,
            "rate_hz": latency.pacing.rate_hz,
            "spin_us": latency.pacing.spin_us,
            "findings": [asdict(finding) for finding in examination.findings],
            "lateness_us": latency.quantiles_us,
            "lateness_histogram": _classes(latency),
            "ticks": latency.lateness_us.size,
            "periods_missed": int(latency.missed.sum()),
            "late_share": latency.late_share,
            "stolen_s": latency.stolen_s,
            "axes": [asdict(delay) for delay in delays],
            "applied": [write._asdict() for write in writes],
            "versions": versions(),
        }
    )

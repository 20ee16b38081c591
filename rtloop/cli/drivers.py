"""`rtloop drivers`: list the backends, or test the channels of a configuration."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT, PositiveFloat
from rtloop.cli.output import echo_json, print_result
from rtloop.cli.output.progress import StatusLine
from rtloop.workbench.tables import console, escape, table

POSITIVE = PositiveFloat(0.0, 1e6, min_open=True)


@click.command()
@click.option(
    "--selftest",
    "config",
    type=OUTPUT,
    metavar="CONFIG",
    help="Test the channels of CONFIG: drive the outputs, measure the inputs.",
)
@click.option(
    "--amplitude",
    "amplitude_v",
    type=POSITIVE,
    default=1.0,
    show_default=True,
    help="Largest step from the safe value, in V. The axis's limits and the channel's range still apply.",
)
@click.option("--loopback", is_flag=True, help="Judge gain and offset; every output must be wired to its input.")
@click.option(
    "--gain-tolerance",
    type=POSITIVE,
    default=0.01,
    show_default=True,
    help="Largest deviation of a gain from 1 that --loopback accepts.",
)
@click.option(
    "--offset-tolerance",
    "offset_v",
    type=POSITIVE,
    default=0.01,
    show_default=True,
    help="Largest offset, in V, that --loopback accepts.",
)
@JSON
@report_errors
def drivers(
    config: Path | None, amplitude_v: float, loopback: bool, gain_tolerance: float, offset_v: float, as_json: bool
) -> int:
    """List the backends, or test the channels of a configuration.

    With --selftest, measures gain, offset, noise and delay of each channel, the highest rate, and the exchange with a
    node.

    The self-test moves outputs: disconnect fragile loads first. Exit 1 where the self-test fails.
    """
    if config is None:
        entries = list_drivers()
        echo_json({"drivers": entries}) if as_json else _print_drivers(entries)
        return 0
    from rtloop.configuration.file import load
    from rtloop.doctor.selftest import SelfTest, Tolerances

    test = SelfTest(load(config), amplitude_v)
    for line in test.announcement():
        click.echo(line, err=True)
    with StatusLine("staircase", sys.stderr) as status:
        report = test.run(Tolerances(gain_tolerance, offset_v) if loopback else None, status.update)
    print_result(report, as_json, _print_report)
    return 1 if report["passed"] is False else 0


def list_drivers() -> Sequence[Mapping[str, object]]:
    """Return a dict for each registered kind of driver: kind, defined_in, real, max_rate_hz, problem.

    `defined_in` is the driver's module. `real` is whether the driver with default options moves hardware, `max_rate_hz`
    its highest rate (None: any). `problem` is the reason that prevents the driver's use, else None; with a problem,
    `real` and `max_rate_hz` are None.
    """
    from rtloop.drivers.errors import DriverError
    from rtloop.drivers.registry import driver_class, kinds

    entries = []
    for kind, module in kinds().items():
        entry = {"kind": kind, "defined_in": module, "real": None, "max_rate_hz": None, "problem": None}
        try:
            driver = driver_class(kind)
            facts = driver(driver.options_model(), {"x": driver.example}, 1000.0).facts
            limit_hz = None if facts.max_rate_hz == float("inf") else facts.max_rate_hz
            entry |= {"real": facts.real, "max_rate_hz": limit_hz}
        except (DriverError, ValueError) as error:
            entry["problem"] = str(error)
        entries.append(entry)
    return entries


def _print_drivers(entries: Sequence[Mapping[str, Any]]) -> None:
    """Print the entries of `list_drivers` as a table."""
    rows = table("kind", "moves hardware", "clock", "highest rate", "defined in")
    for entry in entries:
        if entry["problem"]:
            rows.add_row(entry["kind"], f"[red]{escape(entry['problem'])}[/]", "", "", entry["defined_in"])
            continue
        rate = "any" if entry["max_rate_hz"] is None else f"{entry['max_rate_hz']:g} Hz"
        rows.add_row(entry["kind"], "yes" if entry["real"] else "no", "rtloop's", rate, entry["defined_in"])
    console().print(rows)


def _print_report(report: dict[str, Any]) -> None:
    """Print a driver's self-test: `report` is the object of `rtloop drivers --selftest --json`."""
    out, rows = console(), table("axis", "gain", "offset", "noise, rms", "delay, ticks", "")
    for row in report["axes"]:
        delay = "does not follow" if row["delay_ticks"] is None else f"{row['delay_ticks']}"
        failure = "no loopback" if report["tolerances"] else "wrong sign"
        verdict = {None: "", True: "within tolerance", False: f"[red]{failure}[/]"}[row["passed"]]
        rows.add_row(f"{row['axis']}: {row['output']} → {row['input']}", f"{row['gain']:.5f}",
                     f"{row['offset_v'] * 1e3:.3f} mV", f"{row['noise_v'] * 1e3:.3f} mV", delay, verdict)  # fmt: skip
    out.print(rows)
    if (exchange := report["exchange"]) is not None:
        out.print(
            f"exchange with the node: p50 {exchange['p50_us']:.1f} µs, p99 {exchange['p99_us']:.1f} µs, largest "
            f"{exchange['max_us']:.1f} µs; {exchange['late']} of {exchange['count']} exchanges took longer "
            f"than a period, {exchange['lost']} got no answer"
        )
        out.print(
            f"this exchange adds {exchange['added_us']:.1f} µs to the model's delay; `rtloop check` compares the added "
            "delay with the loop's delay margin"
        )
    for rate in report["rates"]:
        out.print(f"{rate['rate_hz']:g} Hz: {rate['missed_share']:.2%} of the periods missed")
    highest = report["highest_rate_hz"]
    out.print(f"highest rate reached: {'none of these' if highest is None else f'{highest:g} Hz'}")
    if report["tolerances"] is None:
        for row in report["axes"]:
            if row["passed"] is False:
                out.print(
                    f"[red]{row['axis']}: the sign is wrong: the position falls by {-row['slope_um_per_v']:.3g} µm per "
                    "volt of drive. A loop whose controller expects a rising position is unstable. Change the sign "
                    "of um_per_v in driver.channels, or reverse the wires of sensor or drive[/]"
                )
        note = "" if report["real"] else " (simulated by this driver)"
        out.print(
            f"no verdict on gain and offset: gain and offset include the plant between output and input{note}. "
            "To judge them: wire every output to its input and use --loopback"
        )

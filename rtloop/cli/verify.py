"""`rtloop design verify`: the loops of a configuration judged by their specifications."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import CONFIG, JSON, OUTPUT, TARGET
from rtloop.cli.output import echo_json, print_warnings
from rtloop.cli.output.progress import StatusLine
from rtloop.errors import ConfigError
from rtloop.workbench.tables import console, escape, table
from rtloop.workbench.written_files import write_outputs

if TYPE_CHECKING:
    from rich.table import Table

    from rtloop.configuration.checks import AxisCheck
    from rtloop.configuration.file import Configuration
    from rtloop.design.verification.axes import Verifications
    from rtloop.design.verification.verify import Verification


RED = {"MISSED", "NO"}


@click.command()
@CONFIG
@click.option(
    "--spec", type=OUTPUT, help="Specification file for all axes.  [default: key `specification` of each axis]"
)
@click.option("--out", type=TARGET, help="Folder for verify.html, verify.json and pictures (needs rtloop[plot]).")
@JSON
@report_errors
def verify(config: Path, spec: Path | None, out: Path | None, as_json: bool) -> int:
    """Judge the loops of CONFIG by their specifications.

    Shows every limit with the achieved value and the verdict, then margins and robustness.

    Exit 1 where a loop, as it will run, is unstable or misses its specification; 0 where every loop meets it.
    """
    return verify_configuration(config, spec, out, as_json)


def verify_configuration(config: Path, spec: Path | None, out: Path | None, as_json: bool) -> int:
    """Judge and print every axis that has a controller; write a report to the folder `out`, if given. A terminal shows
    the present step.

    Returns the exit code: 1 where a loop is unstable or misses its specification, else 0. `spec` replaces the axes' own
    specifications. Raises ConfigError for an invalid configuration or specification, if no axis has a controller, or
    where python-control computes other figures; InputFileError for a file that cannot be read, OutputError for a report
    that cannot be written, MissingExtra for a report without matplotlib.
    """
    with StatusLine("judging the linear loops", sys.stderr) as status:
        from rtloop.configuration.checks import Findings, check_axes
        from rtloop.configuration.file import load
        from rtloop.design.verification.axes import add_simulation, verify_axis
        from rtloop.design.verification.json_values import as_dict

        configuration = load(config)
        findings = Findings()
        checks = check_axes(configuration, findings)
        if any(check.law is None and configuration.axes[i].controller for i, check in enumerate(checks)):
            raise ConfigError(str(config), findings.faults)
        verifications = {check.name: verify_axis(configuration, check, spec) for check in checks if check.law}
        if not verifications:
            raise ConfigError(str(config), ["axis: no axis has a controller; verification needs [axis.controller]"])
        _require_second_opinion(configuration, checks, verifications)
        status.update("simulating steps")
        verifications = add_simulation(configuration, verifications)
    meets_all = all(verification.meets_specification for verification, _ in verifications.values())
    report: dict[str, object] = {
        "name": configuration.name,
        "meets": meets_all,
        "axes": [{"name": name, **as_dict(verification)} for name, (verification, _) in verifications.items()],
    }
    files = [] if out is None else _write_report(out, configuration.name, verifications, report)
    if as_json:
        echo_json({**report, "files": [str(file) for file in files]})
    else:
        for name, (verification, _) in verifications.items():
            _print_verification(name, verification)
        for file in files:
            click.echo(file, err=True)
    return 0 if meets_all else 1


def _require_second_opinion(
    configuration: Configuration, checks: Sequence[AxisCheck], verifications: Verifications
) -> None:
    """Raise ConfigError with every quantity of a verified loop for which python-control computes another value."""
    from rtloop.configuration.second_opinion import axis_faults  # more than a second of import

    faults = list[str]()
    for axis, check in zip(configuration.axes, checks, strict=True):
        if check.name in verifications:
            verification, design = verifications[check.name]
            model, loop = axis.model or design.plant, verification.running
            faults += axis_faults(
                check, model, axis.prefilter, loop, verification.delay_ticks, design.sensor.bandwidth_hz
            )
    if faults:
        raise ConfigError(configuration.source, faults)


def _write_report(folder: Path, name: str, verifications: Verifications, report: Mapping[str, object]) -> list[Path]:
    """Write verify.json (`report`), verify.html and the pictures of each axis to `folder`, also over existing files.

    A missing folder is made. `name` is the configuration's name in headings. Returns the paths: verify.json,
    verify.html, pictures. Raises MissingExtra without matplotlib, with nothing written; OutputError if the system
    refuses a file, after those before it.
    """
    from rtloop.design.verification.page import page
    from rtloop.design.verification.plots import draw_pictures

    pictures = {
        axis: draw_pictures(verification, design.specification, f"{name}, axis {axis}")
        for axis, (verification, design) in verifications.items()
    }
    html = page(
        f"{name}: verification",
        [(axis, verification, pictures[axis]) for axis, (verification, _) in verifications.items()],
    )
    contents = {
        "verify.json": json.dumps(report, indent=2, allow_nan=False).encode(),
        "verify.html": html.encode(),
        **{f"{axis}-{label}.png": png for axis, files in pictures.items() for label, png in files.items()},
    }
    return write_outputs(folder, contents)


def _print_verification(name: str, verification: Verification) -> None:
    """Print every table of the axis `name`, notes, the verdict and, on stderr, warnings."""
    from rtloop.design.verification import text

    out = console()
    out.print(f"[bold]axis {name}[/]")
    out.print(_table(text.table(verification)))
    if verification.continuous is not None:
        out.print(text.CONTINUOUS_NOTE)
    for block in (text.scenarios(verification), text.simulated(verification)):
        if block:
            out.print()
            out.print(_table(block))
    for note in text.simulation_notes(verification):
        out.print(escape(note))
    if verification.together is not None:
        out.print("\nAll axes of this controller together, as they run")
        out.print(_table([("", ""), *text.simultaneous_rows(verification.together)]))
    if verification.robustness.shifts:
        out.print("\nThe resonance may move by")
        out.print(_table([("", ""), *text.shifts(verification)]))
    out.print()
    out.print(_table(text.robustness(verification)))
    out.print(text.NOTE)
    if verification.host is not None:
        out.print(verification.host.text)
    out.print(f"\n[bold]{escape(text.answer(verification))}[/]")
    print_warnings(verification.warnings)


def _table(lines: Sequence[Sequence[str]]) -> Table:
    """Return a table of `lines`, the headings first, with all columns to the left; cells "MISSED" and "NO" are red."""
    headings, *rows = lines
    cells = [[f"[red]{cell}[/]" if cell in RED else cell for cell in row] for row in rows]
    return table(*headings, rows=cells, words=range(len(headings)))

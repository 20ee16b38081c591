"""`rtloop design synthesise`: an H∞ controller from a specification, as a configuration or its section."""

from __future__ import annotations

from pathlib import Path

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT
from rtloop.cli.output import echo_json


@click.group()
def design() -> None:
    """Design controllers from specifications, and verify them."""


@design.command()
@click.argument("spec", type=OUTPUT)
@click.option("--out", type=OUTPUT, help="The configuration to write [the section alone, to stdout].")
@click.option("--axis", default="x", show_default=True, help="Name of the axis in the configuration that is written.")
@click.option("--cross-check", is_flag=True, help="Compute γ with SLICOT as well (needs the extra 'slycot').")
@JSON
@report_errors
def synthesise(spec: Path, out: Path | None, axis: str, cross_check: bool, as_json: bool) -> None:
    """Compute the H∞ controller for SPEC.toml.

    The order of the controller is reduced; the result is written as [axis.controller].

    SPEC.toml names plant and specification; deploy/paper-spec.toml is a complete example. The file of --out is a
    configuration with a simulated rig of that plant, for `check`, `run` and `ctl controller`. Exit 1 where no
    controller meets the specification; the message names the condition that fails.
    """
    from rtloop.workbench.design import design as design_controller

    result = design_controller(spec, cross_check=cross_check)
    if out is not None:
        result.write(out, axis)
    if as_json:
        echo_json(result.as_dict())
        return
    for line in result.summary_lines:
        click.echo(line, err=True)
    if out is None:
        click.echo(result.section, nl=False)
    else:
        click.echo(
            f"{out} is written. To judge it: rtloop check {out}. To swap it into a running loop: "
            f"rtloop ctl controller {axis} {out}"
        )

"""`rtloop design synthesise`: an H∞ controller from a specification, as a configuration or its section."""

from __future__ import annotations

from pathlib import Path

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT, TARGET
from rtloop.cli.output import echo_json


@click.group()
def design() -> None:
    """Design controllers from specifications, and verify them."""


@design.command()
@click.argument("spec", type=OUTPUT)
@click.option(
    "--model", type=OUTPUT,
    help="File that `rtloop identify dynamics` wrote: its [axis.model] replaces [plant] of SPEC; its "
    "[axis.feedforward], if there is one, goes into --out.  [default: [plant] of SPEC]",
)  # fmt: skip
@click.option("--out", type=TARGET, help="Configuration file to write.  [default: only [axis.controller], to stdout]")
@click.option("--axis", default="x", show_default=True, help="Name of the axis in the configuration that is written.")
@click.option(
    "--cross-check",
    is_flag=True,
    help="Compute γ_opt a second time, with SLICOT, for comparison (needs rtloop[slycot]).",
)
@JSON
@report_errors
def synthesise(spec: Path, model: Path | None, out: Path | None, axis: str, cross_check: bool, as_json: bool) -> None:
    """Compute the H∞ controller for SPEC.toml.

    The order of the controller is reduced; the result is written as [axis.controller].

    SPEC.toml names plant and specification; deploy/paper-spec.toml is a complete example. The file of --out is a
    configuration with a simulated rig of that plant, for `check`, `run` and `ctl controller`.

    Exit 1 where no controller is found: none has γ up to synthesis.largest_gamma, or none runs at the rate. A found
    controller may miss each requirement by up to the factor γ. The last line is the verdict of `check`; the exit code
    is 0 whatever it says.
    """
    from rtloop.workbench.design import design as design_controller

    result = design_controller(spec, model=model, cross_check=cross_check)
    if out is not None:
        result.write(out, axis)
    if as_json:
        echo_json(result.as_dict())
        return
    for line in result.summary_lines:
        click.echo(line, err=True)
    if out is None:
        click.echo(result.section, nl=False)
        click.echo(f"{spec}: {result.verdict}", err=True)
    else:
        click.echo(f"{spec}: {result.verdict}")
        if result.actuator is None:
            click.echo(
                f"[axis.feedforward] of {out} is a placeholder; use --model FILE, where FILE contains an identified "
                "[axis.feedforward]",
                err=True,
            )
        click.echo(
            f"{out} is written. To judge it: rtloop check {out}. To swap it into a running loop: "
            f"rtloop ctl controller {axis} {out}"
        )

"""Commands of `ctl` and `identify` about a measured loop: of a service that runs, and of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rtloop.cli.ctl import client_of, ctl
from rtloop.cli.identify import AXIS, PLOT, identify
from rtloop.cli.options import JSON, OUTPUT, fails_clearly

AMPLITUDE = click.option(
    "--amplitude-um", default=0.5, show_default=True, type=click.FloatRange(0, min_open=True),
    help="The position is moved by no more than this.",
)  # fmt: skip
DURATION = click.option(
    "--duration",
    "duration_s",
    default=6.0,
    show_default=True,
    type=click.FloatRange(1, 60),
    help="Of the largest multisine, in s; smaller ones go before it.",
)
PERIOD = click.option(
    "--period", "period_s", type=click.FloatRange(0.05, 10), help="Of the multisine, in s [by the light mode's width]."
)
NEAR = click.option(
    "--near-hz", type=click.FloatRange(0, min_open=True), help="Where a light mode is expected [model]."
)
OUT = click.option("--out", type=OUTPUT, help="The JSON file to write, never over an existing one.")


@ctl.command("response")
@click.argument("axis")
@AMPLITUDE
@click.option("--from-hz", type=click.FloatRange(0, min_open=True), help="Lowest frequency [two lines].")
@click.option("--to-hz", type=click.FloatRange(0, min_open=True), help="Highest frequency [0.45 of the rate].")
@DURATION
@PERIOD
@NEAR
@OUT
@PLOT
@JSON
@click.pass_context
@fails_clearly
def of_a_service(
    context: click.Context, axis: str, out: Path | None, plot: Path | None, as_json: bool, **asked: Any
) -> int:
    """Measure the closed loop of AXIS: L, S, margins.

    A multisine about the reference that is held, which comes back afterwards, also at Ctrl-C and at any error.
    """
    from rtloop.commands.response import show_measured

    return show_measured(client_of(context), {"axis": axis, **asked}, out, plot, as_json)


@ctl.command("resonance")
@click.argument("axis")
@AMPLITUDE
@DURATION
@PERIOD
@NEAR
@JSON
@click.pass_context
@fails_clearly
def resonance_of_a_service(context: click.Context, axis: str, as_json: bool, **asked: Any) -> int:
    """Measure the light mode of AXIS in closed loop: frequency and damping."""
    from rtloop.commands.response import show_measured

    return show_measured(client_of(context), {"axis": axis, "resonance_only": True, **asked}, None, None, as_json)


@identify.command("response")
@click.argument("run", type=OUTPUT)
@AXIS
@NEAR
@OUT
@PLOT
@JSON
@fails_clearly
def of_a_recording(
    run: Path, axis: str | None, near_hz: float | None, out: Path | None, plot: Path | None, as_json: bool
) -> int:
    """Loop, margins and light mode of a closed loop that was moved by a multisine.

    RUN is the recording of a service that was asked by `rtloop ctl response`, or of the experiment `response`.
    """
    from rtloop.commands.response import show_recorded

    return show_recorded(run, axis, near_hz, out, plot, as_json)


@identify.command("resonance")
@click.argument("run", type=OUTPUT)
@AXIS
@NEAR
@JSON
@fails_clearly
def resonance_of_a_recording(run: Path, axis: str | None, near_hz: float | None, as_json: bool) -> int:
    """The light mode of a plant in closed loop, with its uncertainty.

    RUN is as for `rtloop identify response`; `rtloop ctl resonance` measures it on a loop that runs.
    """
    from rtloop.commands.response import show_recorded

    return show_recorded(run, axis, near_hz, None, None, as_json, resonance_only=True)


COMMANDS: tuple[click.Command, ...] = ()
"""All of them belong to `ctl` and `identify`."""

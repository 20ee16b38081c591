"""`rtloop identify dynamics`: D(s) from recorded steps, other excitations or a closed loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.identify import AXIS, OUT, PLOT, RUNS, print_identified
from rtloop.cli.options import JSON, OUTPUT
from rtloop.cli.output import print_warnings


@click.command()
@RUNS
@AXIS
@click.option(
    "--hysteresis", type=OUTPUT, help="File with [axis.feedforward].  [default: the configuration in the recording]"
)
@click.option(
    "--input", default="hysteresis", show_default=True,
    type=click.Choice(["hysteresis", "command", "drive"]),
    help="Input of the dynamics: output of the hysteresis model, recorded command v, or recorded drive.",
)  # fmt: skip
@click.option("--order", type=click.IntRange(1, 20), help="Number of poles.  [default: found by a search]")
@click.option(
    "--largest-order",
    default=14,
    show_default=True,
    type=click.IntRange(1, 20),
    help="Largest number of poles in the search.",
)
@click.option("--delay", type=click.IntRange(0, 16), help="Delay in samples.  [default: found by a search from 0 to 5]")
@click.option(
    "--criterion", type=click.Choice(["aic", "held-out", "validation"]),
    help="Criterion for the number of poles; a closed loop allows only held-out.  [default: held-out]",
)  # fmt: skip
@click.option(
    "--loop",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "open", "closed"]),
    help="State of the loop in the recording; auto: from the recorded mode; open, if no mode is recorded.",
)
@click.option(
    "--outside", multiple=True, metavar="SIGNAL",
    help="Recorded signal that excited the closed loop and is independent of its noise; repeatable.  "
    "[default: reference and feed of the axis]",
)  # fmt: skip
@click.option("--detrend", is_flag=True, help="Subtract the straight line of input and position, as of a drift.")
@click.option(
    "--compare",
    type=OUTPUT,
    help="Recording of a chirp or multisine, with whose frequency response the model is compared.",
)
@OUT
@PLOT
@JSON
@report_errors
def dynamics(runs: tuple[Path, ...], out: Path | None, plot: Path | None, as_json: bool, **options: Any) -> None:
    """Identify the dynamics D(s) of an axis.

    The first RUN identifies the model; further RUNs validate it. A RUN has a step or another excitation, best after a
    rest of a hundred samples, or it is a closed loop whose reference moves.
    """
    from rtloop.design.identification.model_sections import require_new
    from rtloop.workbench.dynamics import fit_dynamics

    require_new(out)
    print_identified(fit_dynamics(runs, **options, warn=print_warnings), out, plot, as_json)

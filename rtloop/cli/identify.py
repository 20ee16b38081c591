"""`rtloop identify hysteresis`: a play model of the actuator from recorded slow drives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT, TARGET, NumberList
from rtloop.cli.output import echo_json, print_warnings
from rtloop.workbench.tables import console

if TYPE_CHECKING:
    from rtloop.workbench.identified_model import IdentifiedModel
RUNS = click.argument("runs", metavar="RUN...", type=OUTPUT, nargs=-1, required=True)
AXIS = click.option("--axis", help="Name of the axis.  [default: the only axis]")
OUT = click.option("--out", type=TARGET, help="TOML file to write; an existing file is not overwritten.")
PLOT = click.option("--plot", type=TARGET, help="Picture (PNG) to write.")


@click.group()
def identify() -> None:
    """Identify actuator, dynamics and closed loop from recordings."""


@identify.command()
@RUNS
@AXIS
@click.option("--operators", default=15, show_default=True, type=click.IntRange(1, 64), help="Number of plays.")
@click.option(
    "--placement", default="auto", show_default=True,
    type=click.Choice(["auto", "chebyshev", "chebyshev-from-0", "uniform"]),
    help="Placement of the thresholds: with a dead band (chebyshev) or without; auto: the one with less error.",
)  # fmt: skip
@click.option(
    "--thresholds",
    type=NumberList(),
    help="Thresholds in V, such as '0,0.5,1,2', instead of --placement.",
)
@click.option(
    "--weights", default="invertible", show_default=True, type=click.Choice(["invertible", "free"]),
    help="invertible: every partial sum of the weights is above 0, so that an inverse exists; free: no such condition.",
)  # fmt: skip
@click.option(
    "--memory", default="auto", show_default=True, type=click.Choice(["auto", "rest", "unknown"]),
    help="Memory of the actuator at the start of each RUN: none (rest) or unknown; auto: judged by "
    "the drive at the start.",
)  # fmt: skip
@click.option(
    "--validate",
    type=OUTPUT,
    multiple=True,
    help="Recording with which the model is judged, but not fitted; repeatable.",
)
@OUT
@PLOT
@JSON
@report_errors
def hysteresis(runs: tuple[Path, ...], out: Path | None, plot: Path | None, as_json: bool, **options: Any) -> int:
    """Identify thresholds and weights from recorded slow drives.

    Best are sines from rest: each RUN begins at 0 V on a depolarised actuator and shows its initial loading curve.
    Other recordings are accepted too, also a part of a loop from any start. Samples before the actuator's memory is
    known are then left out, and so are plays that no later stroke has moved. The error is stated for data held out of
    the fit.

    Exit 1 where the model has no inverse, unless --weights free allows it.
    """
    from rtloop.design.identification.model_sections import require_new
    from rtloop.workbench.hysteresis import fit_hysteresis

    require_new(out)
    result = fit_hysteresis(runs, **options, warn=print_warnings)
    print_identified(result, out, plot, as_json)
    return 0 if result.is_invertible or options["weights"] == "free" else 1


def print_identified(result: IdentifiedModel, out: Path | None, plot: Path | None, as_json: bool) -> None:
    """Write the model's section to `out` and its picture to `plot`, if given; print the result as JSON or text.

    Raises OutputError for a file that exists (`out`) or cannot be written, MissingExtra without matplotlib.
    """
    if out is not None:
        result.write(out)
    if plot is not None:
        result.save_plot(plot)
    echo_json(result.as_dict()) if as_json else result.print_text(console())

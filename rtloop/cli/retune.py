"""`rtloop ctl retune`: new taps for the resonance and gain measured in a running loop, swapped in at a tick."""

from __future__ import annotations

import json
from typing import IO, TYPE_CHECKING, Any

import click

from rtloop.cli.ctl import AXIS, make_client
from rtloop.cli.exit_codes import report_errors, require_readable
from rtloop.cli.options import JSON, OUTPUT, InputFile
from rtloop.cli.output import echo_json
from rtloop.errors import LoopFault
from rtloop.workbench.tables import console, table

if TYPE_CHECKING:
    from rtloop.client import Client
    from rtloop.client.retuning import Proposal, RetuneRequest


@click.command()
@AXIS
@click.option(
    "--amplitude-um",
    default=0.5,
    show_default=True,
    type=click.FloatRange(0, min_open=True),
    help="Largest movement of the position, in µm, while the resonance is measured.",
)
@click.option(
    "--gain-um",
    type=click.FloatRange(0),
    help="Change of the reference for the measurement of the gain, in µm, towards the middle of the range. 0: the gain "
    "is not measured; the model's gain is used.  [default: a quarter of the specification's largest step]",
)
@click.option(
    "--bound-percent",
    default=15.0,
    show_default=True,
    type=click.FloatRange(0, 50, min_open=True),
    help="Largest difference of the measured resonance or gain from the model's, in %; beyond it, the taps stay.",
)
@click.option(
    "--within-percent",
    default=1.0,
    show_default=True,
    type=click.FloatRange(0, 50),
    help="Range around the measured resonance, in ± %, for which the taps are made.",
)
@click.option("--spec", type=OUTPUT, help="Specification file.  [default: key `specification` of the axis]")
@click.option("--yes", is_flag=True, help="Swap better taps in without a question.")
@click.option(
    "--swap",
    "proposal",
    type=InputFile(),
    help="Swap in the taps of this file, which --json wrote, without a new measurement.",
)
@JSON
@click.pass_context
@report_errors
def retune(
    context: click.Context, axis: str, proposal: IO[str] | None, yes: bool, as_json: bool, **options: Any
) -> int:
    """Make new taps of AXIS for its present resonance and gain.

    Resonance and gain are measured in closed loop around the held reference. The taps are computed outside the loop;
    a step with the present taps is compared with a step with the new ones. Better taps are swapped in at a tick, after
    your consent or with --yes; taps that are no better never are. With --json and without --yes, nothing is swapped in,
    and the output is a proposal for --swap. Exit 1 where the old taps stay.
    """
    from rtloop.client.retuning import RetuneRequest

    if proposal is not None:
        return swap_proposal(make_client(context), axis, proposal.read(), as_json)
    if options["spec"] is not None:
        require_readable(options["spec"])
    return retune_axis(make_client(context), RetuneRequest(axis, **options), yes, as_json)


def retune_axis(client: Client, request: RetuneRequest, yes: bool, as_json: bool) -> int:
    """Measure resonance and gain, design and print new taps, and swap better taps in after the user's consent.

    Returns 0 if the new taps were swapped in, else 1. With `yes`, or with `as_json`, the user is not asked: `yes` swaps
    better taps in; `as_json` without `yes` leaves the old ones. Raises RtloopError as `propose_taps`, with the taps
    unchanged, and as `swap_in`: if the service refuses a stage, the stages before it remain swapped in.
    """
    from rtloop.client.retuning import propose_taps, swap_in

    proposal, tick = propose_taps(client, request), None
    if not as_json:
        _print_proposal(proposal)
    if proposal.is_better and (yes or (not as_json and click.confirm("swap the taps in?", err=True))):
        tick = swap_in(client, request.axis, proposal.for_json())
    if as_json:
        echo_json(proposal.for_json() | {"tick": tick})
    elif tick is not None:
        click.echo(f"swapped at tick {tick}")
    elif not proposal.is_better:
        click.echo("the new taps are no better; the loop keeps the present taps")
    return LoopFault.exit_code if tick is None else 0


def swap_proposal(client: Client, axis: str, proposal: str, as_json: bool) -> int:
    """Swap in, by stages, the taps of `proposal`, the text of an earlier `retune --json`.

    Prints the tick of the last stage, with `as_json` as {tick}. Returns 0. Raises ConfigError for another text or an
    unknown axis, LoopFault where the taps have changed since the proposal, RtloopError if the service refuses a stage:
    the stages before it remain swapped in.
    """
    from rtloop.client.retuning import swap_in

    try:
        content = json.loads(proposal)
    except (ValueError, RecursionError):
        content = {}
    tick = swap_in(client, axis, content)
    echo_json({"tick": tick}) if as_json else click.echo(f"swapped at tick {tick}")
    return 0


def _print_proposal(proposal: Proposal) -> None:
    """Print measured resonance and gain, and figures of a step with the present taps and with the new ones."""
    mode, percent, gain, gain_percent = proposal.stage
    click.echo(
        f"resonance {mode['hz']:.2f} ± {mode['hz_std']:.2f} Hz (standard deviation), {percent:+.2f} % from the model's"
    )
    if gain is None:
        click.echo("the gain is not measured; the model's gain is used")
    else:
        distance = "too uncertain: the model's gain is used"
        if gain_percent is not None:
            distance = f"{gain_percent:+.2f} % from the model's"
        span = f"between {gain['from_um']:.4g} and {gain['to_um']:.4g} µm"
        click.echo(
            f"static gain of the plant {gain['value']:.4f} ± {gain['std']:.4f} (standard deviation) {span}, {distance}"
        )
    step_table = table("step from the held reference", "settling / ms", "overshoot / %", "largest v per unit")
    rows = {
        "with the present taps": proposal.before,
        "with the new taps": proposal.after,
        "with the new taps, gain ± its uncertainty": proposal.at_gain_bounds,
    }
    for name, step in rows.items():
        if step is not None:
            figures = (f"{step.settling_ms:.3f}", f"{100 * step.overshoot:.3f}", f"{step.highest_command:.4f}")
            step_table.add_row(name, *figures)
    console().print(step_table)

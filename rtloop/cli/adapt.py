"""Commands of `ctl` that make a running loop better: scans that it learns, taps for its resonance as it is now."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rtloop.cli.ctl import client_of, ctl, numbers_in
from rtloop.cli.options import JSON, OUTPUT, InputFile, fails_clearly, require_text


@ctl.command()
@click.argument("axis")
@click.argument("file", type=InputFile())
@click.option("--cycles", default=5, show_default=True, type=click.IntRange(1, 50), help="Of learning.")
@click.option(
    "--resonance-percent",
    default=2.0,
    show_default=True,
    type=click.FloatRange(0, 50, max_open=True),
    help="Only if the error shrinks with the resonance anywhere within so much of the model's.",
)
@click.option("--out", type=OUTPUT, help="The table that was learned, for `ctl waveform`; never over an existing file.")
@JSON
@click.pass_context
@fails_clearly
def learn(
    context: click.Context, axis: str, file: Any, cycles: int, resonance_percent: float, out: Path | None, as_json: bool
) -> int:  # fmt: skip
    """Learn the scan of AXIS whose period is in FILE.

    A number to a line and tick, in µm. It is played, and corrected by its error from cycle to cycle: the reference, and
    what is added to the command. The best table goes on playing. At Ctrl-C what was held is held again.
    """
    from rtloop.commands.adapt.learn import learn as learn_scan

    samples = [number for numbers in numbers_in(file) for number in numbers[:1]]
    body = {"axis": axis, "samples": samples, "cycles": cycles, "resonance_percent": resonance_percent}
    return learn_scan(client_of(context), body, out, as_json)


@ctl.command()
@click.argument("axis")
@click.option(
    "--amplitude-um",
    default=0.5,
    show_default=True,
    type=click.FloatRange(0, min_open=True),
    help="The position is moved by no more than this while the resonance is measured.",
)
@click.option(
    "--gain-um",
    type=click.FloatRange(0),
    help="References so far from the one held, towards the middle of the range, are held while the gain is measured; "
    "0: it is not, and the model's is taken [a quarter of the specification's largest step].",
)
@click.option(
    "--bound-percent",
    default=15.0,
    show_default=True,
    type=click.FloatRange(0, 50, min_open=True),
    help="A resonance or gain further from the model's changes nothing.",
)
@click.option(
    "--within-percent",
    default=1.0,
    show_default=True,
    type=click.FloatRange(0, 50),
    help="The taps are made for resonances so near the measured one.",
)
@click.option("--spec", type=OUTPUT, help="The specification [the axis's].")
@click.option("--yes", is_flag=True, help="Swap without asking.")
@click.option(
    "--swap", "proposal", type=click.File(), help="Measure nothing: swap in the taps of this output of --json."
)
@JSON
@click.pass_context
@fails_clearly
def retune(context: click.Context, axis: str, proposal: Any, as_json: bool, **asked: Any) -> int:
    """Make the taps of AXIS anew for its resonance and gain as they are now.

    Both are measured in closed loop about the reference that is held; the taps are made beside the loop and swapped in
    at a tick, after a look at a step before and after. Taps that are no better than those in force are not swapped in,
    --yes or not; with --json and without --yes none are, and the output is a proposal for --swap. Exit 1 where the taps
    stayed.
    """
    from rtloop.client.retuning import RetuneRequest
    from rtloop.commands.adapt.retune import retune as retune_axis
    from rtloop.commands.adapt.retune import swap

    if proposal is not None:
        return swap(client_of(context), axis, proposal.read(), as_json)
    if asked["spec"] is not None:
        require_text(asked["spec"])
    yes = asked.pop("yes")
    return retune_axis(client_of(context), RetuneRequest(axis, **asked), yes, as_json)


COMMANDS: tuple[click.Command, ...] = ()
"""All of them belong to `ctl`."""

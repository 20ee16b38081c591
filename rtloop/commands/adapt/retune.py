"""`rtloop ctl retune`: resonance and gain measured in a running loop, taps made anew for them, swapped in at a tick."""

from __future__ import annotations

import json

import click

from rtloop.client import Client
from rtloop.client.retuning import Proposal, RetuneRequest, propose_taps, swap_in
from rtloop.errors import LoopFault
from rtloop.terminal.machine import echo_json
from rtloop.terminal.table import console, table


def retune(client: Client, request: RetuneRequest, yes: bool, as_json: bool) -> int:
    """Measure, redesign, print and, with consent, swap taps; returns 0 if the new taps are in force, else 1.

    `yes` swaps without asking. Raises RtloopError.
    """
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
        click.echo("the new taps are no better than those in force, which stay")
    return LoopFault.exit_code if tick is None else 0


def swap(client: Client, axis: str, proposal: str, as_json: bool) -> int:
    """Swap in the taps of `proposal`, the text that `retune --json` printed earlier. Raises ConfigError, LoopFault."""
    try:
        content = json.loads(proposal)
    except (ValueError, RecursionError):
        content = {}
    tick = swap_in(client, axis, content)
    if as_json:
        echo_json({"tick": tick})
    else:
        click.echo(f"swapped at tick {tick}")
    return 0


def _print_proposal(proposal: Proposal) -> None:
    """Print resonance and gain as measured, and a step with either taps."""
    mode, percent, gain, gain_percent = proposal.stage
    click.echo(f"resonance {mode['hz']:.2f} ± {mode['hz_std']:.2f} Hz, {percent:+.2f} % from the model's")
    if gain is None:
        click.echo("gain not measured; the model's is taken")
    else:
        use = (
            "too uncertain; the model's is taken" if gain_percent is None else f"{gain_percent:+.2f} % from the model's"
        )
        span = f"between {gain['from_um']:.4g} and {gain['to_um']:.4g} µm"
        click.echo(f"gain {gain['value']:.4f} ± {gain['std']:.4f} {span}, {use}")
    steps = table("of a step there", "settling / ms", "overshoot / %", "largest v per unit")
    rows = {
        "with the taps in force": proposal.before,
        "with the new ones": proposal.after,
        "the same, gain off by its ±": proposal.at_gain_bounds,
    }
    for name, step in rows.items():
        if step is not None:
            steps.add_row(name, f"{step.settling_ms:.3f}", f"{100 * step.overshoot:.3f}", f"{step.highest_command:.4f}")
    console().print(steps)

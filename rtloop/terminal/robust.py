"""What the terminal shows of a robust controller and of its taps. No numbers are made here."""

from __future__ import annotations

import click

from rtloop.design.robust.search import RobustDesign
from rtloop.design.robust.section import certified_values
from rtloop.design.robust.shape import Subject, TapDesign


def print_robust(found: RobustDesign) -> None:
    """The worst of everything that is certified, on stderr: stdout is for the section itself."""
    click.echo(f"searched over {found.scenario_count} scenarios; worst of {found.certificate.plants} plants:", err=True)
    for name, value, where in certified_values(found.certificate):
        click.echo(f"  {name} {value:.4g}   ({where})", err=True)


def print_shaped(found: TapDesign, subject: Subject) -> None:
    """What the taps keep, on stderr."""
    proof = found.proof
    for line in (
        f"settling (5 %) {found.settling_ms:.4g} ms, the fastest is {found.fastest_ms:.4g} ms; "
        f"variation of v {found.variation:.3g} per unit step",
        f"worst of {found.proved_count} plants, between ticks too: settling {proof.settling_ms:.4g} ms, "
        f"overshoot {100 * proof.overshoot:.3g} %, undershoot {100 * proof.undershoot:.3g} %, "
        f"v {proof.lowest_command:.4g} … {proof.highest_command:.4g} per unit step",
        f"steps by up to {subject.bounds.step_um:g} µm keep v within "
        f"{subject.bounds.low_um:.4g} … {subject.bounds.high_um:.4g} µm",
    ):
        click.echo(line, err=True)
    if found.curve:
        points = ", ".join(f"{settling_ms:.3g} ms {100 * least:.2g} %" for settling_ms, least in found.curve)
        click.echo(f"least overshoot by settling time: {points}", err=True)

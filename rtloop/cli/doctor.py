"""The command that judges the host."""

from __future__ import annotations

from pathlib import Path

import click

from rtloop.cli.options import JSON, OUTPUT, Seconds, fails_clearly


@click.command()
@click.argument("config", type=OUTPUT, required=False)
@click.option(
    "--seconds", type=Seconds(), default=5.0, show_default=True, help="How long the loop's clock is measured."
)
@click.option("--apply", "change", is_flag=True, help="Change what can be changed on the running host, as root.")
@click.option("--png", type=OUTPUT, metavar="FILE", help="Write the histogram of the lateness as a picture.")
@JSON
@fails_clearly
def doctor(config: Path | None, seconds: float, change: bool, png: Path | None, as_json: bool) -> int:
    """Judge this host for the loop of CONFIG, or for 10 kHz.

    Exit 1 where it is not suitable.

    Looks at what makes ticks late, tells what each thing costs and the command that mends it, measures the lateness of
    the loop's own clock, and compares it with the loop's period and margins. Touches no hardware; changes nothing
    without --apply.
    """
    from rtloop.commands.doctor import doctor_host

    return doctor_host(config, seconds, change, png, as_json)


COMMANDS = (doctor,)

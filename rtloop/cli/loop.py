"""Commands that run a loop, or judge whether one could."""

from __future__ import annotations

from pathlib import Path

import click

from rtloop.cli.options import CONFIG, JSON, OUTPUT, Seconds, fails_clearly


@click.command()
@CONFIG
@click.option("--duration", "duration_s", type=Seconds(), help="Seconds to run, as a number of ticks [until Ctrl-C].")
@click.option("--unpaced", is_flag=True, help="In virtual time, as fast as the machine goes (simulated hardware only).")
@click.option("--out", type=OUTPUT, help="Folder for the recording [the configuration's].")
@JSON
@fails_clearly
def run(config: Path, duration_s: float | None, unpaced: bool, out: Path | None, as_json: bool) -> int:
    """Run the loop of CONFIG and record every tick; Ctrl-C ramps down, finishes the recording and ends well."""
    from rtloop.running import run_configuration

    return run_configuration(config, duration_s, not unpaced, out, as_json)


@click.command()
@CONFIG
@JSON
@fails_clearly
def check(config: Path, as_json: bool) -> int:
    """Validate CONFIG and show what would run: law, C(z) against C(s), margins, limits. Touches no hardware."""
    from rtloop.checking import check_configuration

    return check_configuration(config, as_json)


@click.command()
@fails_clearly
def drivers() -> int:
    """List the backends and what each can do."""
    from rtloop.report import print_drivers

    print_drivers()
    return 0


COMMANDS = (run, check, drivers)

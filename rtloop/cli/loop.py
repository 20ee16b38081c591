"""Commands that run a loop, or judge whether one could."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from rtloop.cli.options import CONFIG, JSON, OUTPUT, Seconds, fails_clearly, require_text
from rtloop.cli.panel import beside, with_panel
from rtloop.terminal.machine import echo_json


class Positive(click.FloatRange):
    """A number above 0, and a number indeed."""

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """The number; a usage error where it is none."""
        number = super().convert(value, param, ctx)
        return self.fail(f"{value}: a number above 0 is needed", param, ctx) if math.isnan(number) else number


POSITIVE = Positive(0.0, 1e6, min_open=True)


@click.command()
@CONFIG
@click.option("--duration", "duration_s", type=Seconds(), help="Seconds to run, as a number of ticks [until Ctrl-C].")
@click.option("--unpaced", is_flag=True, help="In virtual time, as fast as the machine goes (simulated hardware only).")
@click.option("--out", type=OUTPUT, help="Folder for the recording [the configuration's].")
@JSON
@with_panel
@fails_clearly
def run(
    config: Path,
    duration_s: float | None,
    unpaced: bool,
    out: Path | None,
    as_json: bool,
    panel: bool,
    panel_port: int,
) -> int:
    """Run the loop of CONFIG and record every tick.

    Ctrl-C ramps down, finishes the recording and ends with 0. With --panel it runs as `rtloop serve` does, with a
    control socket.
    """
    if panel:
        if unpaced or out is not None or as_json:
            raise click.UsageError("--panel: not allowed with --unpaced, --out and --json")
        require_text(config)
        from rtloop.service.daemon import serve

        with beside(config, panel, panel_port):
            return serve(config, duration_s)
    from rtloop.supervision.interruption import Interruption

    require_text(config)
    with Interruption() as interruption:
        from rtloop.commands.run import run_configuration

        return run_configuration(config, duration_s, not unpaced, out, as_json, interruption)


@click.command()
@CONFIG
@click.option("--strict", is_flag=True, help="Warnings are faults.")
@JSON
@fails_clearly
def check(config: Path, strict: bool, as_json: bool) -> int:
    """Show what CONFIG would run, and judge it; touches no hardware.

    Limits, C(z) against C(s), margins on the model, and what the axis's specification says of it.
    """
    require_text(config)
    from rtloop.commands.check import check_configuration

    return check_configuration(config, strict, as_json)


@click.command()
@click.option("--selftest", "config", type=OUTPUT, metavar="CONFIG", help="Drive the channels of CONFIG and measure.")
@click.option(
    "--amplitude",
    "amplitude_v",
    type=POSITIVE,
    default=1.0,
    show_default=True,
    help="Volts from the safe value; the axis's limits and the channel's range hold all the same.",
)
@click.option("--loopback", is_flag=True, help="Every output is wired to its input: judge gain and offset.")
@click.option("--gain-tolerance", type=POSITIVE, default=0.01, show_default=True)
@click.option("--offset-tolerance", "offset_v", type=POSITIVE, default=0.01, show_default=True)
@JSON
@fails_clearly
def drivers(
    config: Path | None, amplitude_v: float, loopback: bool, gain_tolerance: float, offset_v: float, as_json: bool
) -> int:
    """List the backends, or test the channels of a configuration.

    The test measures gain, offset, noise, delay and the highest rate.

    The self-test moves outputs: nothing fragile may hang on them.
    """
    if config is None:
        from rtloop.terminal.run import known_drivers, print_drivers

        if as_json:
            echo_json({"drivers": known_drivers()})
        else:
            print_drivers()
        return 0
    from rtloop.commands.selftest import Tolerances, selftest_configuration

    return selftest_configuration(
        config, amplitude_v, Tolerances(gain_tolerance, offset_v) if loopback else None, as_json
    )


COMMANDS = (run, check, drivers)

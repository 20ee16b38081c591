"""Commands that make a controller, and judge one."""

from __future__ import annotations

from pathlib import Path

import click

from rtloop.cli.options import CONFIG, JSON, OUTPUT, fails_clearly


@click.group()
def design() -> None:
    """From a specification to a verified controller."""


@design.command()
@click.argument("spec", type=OUTPUT)
@click.option("--out", type=OUTPUT, help="The configuration to write [the section alone, to stdout].")
@click.option("--axis", default="x", show_default=True, help="Name of the axis in the configuration that is written.")
@click.option("--cross-check", is_flag=True, help="Compute γ with SLICOT as well (extra: slycot).")
@JSON
@fails_clearly
def synthesise(spec: Path, out: Path | None, axis: str, cross_check: bool, as_json: bool) -> int:
    """Compute the H∞ controller that SPEC.toml asks for.

    It is reduced, and written as [axis.controller].

    SPEC.toml names plant and specification; deploy/paper-spec.toml is a complete example. What --out writes is a
    configuration around a simulated rig of that plant: `check` and `run` take it, and `ctl controller` swaps its
    controller into a running loop. Exit 1 where no controller does what is asked, with the condition that fails.
    """
    from rtloop.commands.design.synthesise import synthesise_specification

    return synthesise_specification(spec, out, axis, cross_check, as_json)


@design.command()
@CONFIG
@click.option("--spec", type=OUTPUT, help="The specification [each axis's key `specification`].")
@click.option("--out", type=OUTPUT, help="Folder for verify.html, verify.json and pictures (extra: plot).")
@JSON
@fails_clearly
def verify(config: Path, spec: Path | None, out: Path | None, as_json: bool) -> int:
    """Judge the loops of CONFIG by their specifications.

    Every specification with what is required, what is achieved and the verdict; margins; robustness.

    Exit 1, "the answer is no", where a loop as it will run is unstable or misses a specification; 0 where all are met.
    """
    from rtloop.commands.design.verify import verify_configuration

    return verify_configuration(config, spec, out, as_json)


@design.command()
@click.argument("spec", type=OUTPUT)
@click.option("--config", type=OUTPUT, help="A configuration whose controller is replaced [one of its own].")
@click.option("--out", type=OUTPUT, help="The configuration to write [the section alone, to stdout].")
@click.option("--axis", default="x", show_default=True, help="Name of the axis in the configuration that is written.")
@JSON
@fails_clearly
def robust(spec: Path, config: Path | None, out: Path | None, axis: str, as_json: bool) -> int:
    """Search a controller that damps the resonances of SPEC.toml wherever they lie in their ranges.

    A PI part and biquads, whose slowest closed-loop mode around a resonance dies away as fast as can be over all
    [scenarios], with walls on max |S|, on the disturbance and on noise; certified over sweeps and random plants.

    Takes minutes; deploy/robust-spec.toml is a complete example. Exit 1 where nothing found keeps what is asked.
    """
    from rtloop.commands.design.robust import search_specification

    return search_specification(spec, config, out, axis, as_json)


@design.command()
@CONFIG
@click.option("--spec", type=OUTPUT, help="The specification [the axis's key `specification`].")
@click.option("--out", type=OUTPUT, help="The configuration to write [the section alone, to stdout].")
@click.option("--axis", default="x", show_default=True, help="The axis whose taps are made.")
@click.option("--plot", type=OUTPUT, help="A picture, .png: the trade-off and the step (extra: plot).")
@JSON
@fails_clearly
def shape(config: Path, spec: Path | None, out: Path | None, axis: str, plot: Path | None, as_json: bool) -> int:
    """Make the taps with which the loop of CONFIG steps as fast as its drive allows.

    Both rows of [axis.prefilter], by linear programming over [shape.scenarios]: the least settling time with which
    overshoot, undershoot and v stay within their limits, then the least variation of v.

    Exit 1 where there are none, with the constraint that binds and the fastest that is possible.
    """
    from rtloop.commands.design.robust import shape_configuration

    return shape_configuration(config, spec, out, axis, plot, as_json)


COMMANDS = (design,)

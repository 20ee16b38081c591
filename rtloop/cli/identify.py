"""Commands that make models of recordings: hysteresis, dynamics, and what compensation leaves of the first."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import click

from rtloop.cli.design import design
from rtloop.cli.options import CONFIG, JSON, OUTPUT, fails_clearly
from rtloop.terminal.machine import echo_json

RUNS = click.argument("runs", metavar="RUN...", type=OUTPUT, nargs=-1, required=True)
AXIS = click.option("--axis", help="Name of the axis [the only one].")
OUT = click.option("--out", type=OUTPUT, help="The TOML file to write, never over an existing one.")
PLOT = click.option("--plot", type=OUTPUT, help="The picture (PNG) to write.")


class Numbers(click.ParamType):
    """Numbers separated by commas."""

    name = "numbers"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, ...]:
        """The numbers; a usage error for anything else."""
        if isinstance(value, tuple):
            return value
        try:
            return tuple(float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"{value}: numbers separated by commas are needed", param, ctx)


@click.group()
def identify() -> None:
    """Make models of the actuator from recordings."""


@identify.command()
@RUNS
@AXIS
@click.option("--operators", default=15, show_default=True, type=click.IntRange(1, 64), help="Number of plays.")
@click.option(
    "--placement", default="auto", show_default=True,
    type=click.Choice(["auto", "chebyshev", "chebyshev-from-0", "uniform"]),
    help="Of thresholds: with a dead band (chebyshev) or without; auto takes what errs less.",
)  # fmt: skip
@click.option("--thresholds", type=Numbers(), help="Thresholds in V instead: '0,0.5,1,2'.")
@click.option(
    "--weights", default="invertible", show_default=True, type=click.Choice(["invertible", "free"]),
    help="Keep every partial sum above 0, so that an inverse exists, or not.",
)  # fmt: skip
@click.option(
    "--memory", default="auto", show_default=True, type=click.Choice(["auto", "rest", "unknown"]),
    help="Of the actuator at the start of each RUN: none (rest), or unknown; auto asks where its drive begins.",
)  # fmt: skip
@click.option("--validate", type=OUTPUT, multiple=True, help="A recording to judge the model on; repeatable.")
@OUT
@PLOT
@JSON
@fails_clearly
def hysteresis(
    runs: tuple[Path, ...], axis: str | None, operators: int,
    placement: Literal["auto", "chebyshev", "chebyshev-from-0", "uniform"],
    thresholds: tuple[float, ...] | None, weights: Literal["invertible", "free"],
    memory: Literal["auto", "rest", "unknown"], validate: tuple[Path, ...], out: Path | None, plot: Path | None,
    as_json: bool,
) -> int:  # fmt: skip
    """Thresholds and weights from recorded slow drives.

    Sines from rest tell most: RUNs that each begin at 0 V on a depolarised actuator and show its initial loading
    curve. Any others do as well: part of a loop, from anywhere. What the drive does before the actuator's memory is
    known is then left out, and so are plays that no later stroke has shown. The error is that on data held out of the
    fit.
    """
    from rtloop.commands.identify import hysteresis_report
    from rtloop.terminal.identification import print_hysteresis

    report = hysteresis_report(
        runs,
        axis=axis,
        count=operators,
        placement=placement,
        thresholds_v=thresholds,
        weights=weights,
        memory=memory,
        validate=validate,
        out=out,
        plot=plot,
    )
    _show(report, as_json, print_hysteresis)
    return 0 if report["invertible"] or weights == "free" else 1


@identify.command()
@RUNS
@AXIS
@click.option("--hysteresis", type=OUTPUT, help="File with [axis.feedforward] [the recording's own configuration].")
@click.option(
    "--input", "how", default="hysteresis", show_default=True, type=click.Choice(["hysteresis", "command", "drive"]),
    help="Input of the dynamics: output of the hysteresis model, recorded command v, or the drive itself.",
)  # fmt: skip
@click.option("--order", type=click.IntRange(1, 20), help="Number of poles [searched].")
@click.option("--largest-order", default=14, show_default=True, type=click.IntRange(1, 20))
@click.option("--delay", "delay_ticks", type=click.IntRange(0, 16), help="Samples of delay [0 to 5, found].")
@click.option(
    "--criterion", type=click.Choice(["aic", "held-out", "validation"]),
    help="What chooses the order [held-out; a closed loop allows no other].",
)  # fmt: skip
@click.option(
    "--loop",
    "state",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "open", "closed"]),
    help="Was the loop closed? auto goes by the recorded mode; a recording without one was open.",
)
@click.option(
    "--outside", multiple=True, metavar="SIGNAL",
    help="Recorded signal that moved the closed loop, owing nothing to its noise [the axis's reference and feed].",
)  # fmt: skip
@click.option("--compare", type=OUTPUT, help="Recording of a chirp or multisine: measured frequency response.")
@OUT
@PLOT
@JSON
@fails_clearly
def dynamics(
    runs: tuple[Path, ...], axis: str | None, hysteresis: Path | None, how: Literal["hysteresis", "command", "drive"],
    order: int | None, largest_order: int, delay_ticks: int | None,
    criterion: Literal["aic", "held-out", "validation"] | None, state: Literal["auto", "open", "closed"],
    outside: tuple[str, ...], compare: Path | None, out: Path | None, plot: Path | None, as_json: bool,
) -> int:  # fmt: skip
    """D(s) from a step, or another excitation, from rest; or from a closed loop whose reference moves.

    It is identified from the first RUN; further RUNs validate it.
    """
    from rtloop.commands.identify import dynamics_report
    from rtloop.terminal.identification import print_dynamics

    report = dynamics_report(
        runs, axis=axis, how=how, hysteresis=hysteresis, state=state, outside=outside, order=order,
        largest_order=largest_order, delay_ticks=delay_ticks, criterion=criterion, compare=compare, out=out, plot=plot,
    )  # fmt: skip
    _show(report, as_json, print_dynamics)
    return 0


@design.command()
@CONFIG
@click.option("--actuator", type=OUTPUT, required=True, help="File with the identified [axis.feedforward].")
@AXIS
@click.option("--command-um", type=click.FloatRange(0, min_open=True), help="Largest |v| [limits.command_um].")
@PLOT
@JSON
@fails_clearly
def compensation(
    config: Path, actuator: Path, axis: str | None, command_um: float | None, plot: Path | None, as_json: bool
) -> int:
    """What the inverse of CONFIG leaves of the hysteresis.

    On the identified actuator: ρ, Ω and its bound ξ.
    """
    from rtloop.commands.identify import compensation_report
    from rtloop.terminal.identification import print_compensation

    report = compensation_report(config, actuator, axis=axis, command_um=command_um, plot=plot)
    _show(report, as_json, print_compensation)
    return 0


@design.command()
@click.argument("hysteresis", metavar="HYST", type=OUTPUT)
@click.argument("step", metavar="STEP", type=OUTPUT)
@click.option("--specs", type=OUTPUT, required=True, help="What the loop is asked to do; its [plant] is not used.")
@click.option("--out", type=OUTPUT, required=True, help="The configuration to write, never over an existing file.")
@AXIS
@click.option("--order", type=click.IntRange(1, 20), help="Number of poles of the dynamics [searched].")
@click.option(
    "--robust", is_flag=True, help="Damp the resonance, and make both rows of taps: minutes instead of seconds."
)
@JSON
@fails_clearly
def auto(
    hysteresis: Path, step: Path, specs: Path, out: Path, axis: str | None, order: int | None, robust: bool,
    as_json: bool,
) -> int:  # fmt: skip
    """Identify, synthesise, write a configuration, verify it.

    Two recordings and a specification go in; the configuration that comes out runs. With --robust the controller is one
    that "design robust" finds, with the taps of "design shape", as [scenarios], [robust] and [shape] ask.

    HYST is a slow sine from rest, STEP a step; driver and limits are those that STEP was recorded with. Exit 1 where
    the loop misses the specification; the configuration is written all the same.
    """
    from rtloop.commands.design.auto import design_from_recordings

    return design_from_recordings(hysteresis, step, specs, out, axis, order, robust, as_json)


def _show(report: dict[str, Any], as_json: bool, for_people: Callable[[dict[str, Any]], None]) -> None:
    if as_json:
        echo_json(report)
    else:
        for_people(report)


COMMANDS = (identify,)
"""`compensation` and `auto` belong to `design`."""

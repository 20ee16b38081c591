"""Commands that run experiments, and report what came of them."""

from __future__ import annotations

from pathlib import Path

import click

from rtloop.cli.options import CONFIG, JSON, OUTPUT, fails_clearly

SET = click.option(
    "--set",
    "settings",
    metavar="EXPERIMENT.KEY=VALUE",
    multiple=True,
    help="A parameter; see `rtloop experiment list`.",
)
AXIS = click.option("--axis", help="Name of the axis [the only one]; every other one rests.")
PACED = click.option("--paced", is_flag=True, help="In real time even where virtual time would do; hardware always is.")
BESIDE = click.option(
    "--beside",
    metavar="CONFIG",
    type=OUTPUT,
    help="Another configuration, which does the same; its figures stand beside, and its steps in the same picture.",
)
OUT = click.option("--out", type=OUTPUT, help="Folder for recordings and report [a new one with the recordings].")


@click.group()
def experiment() -> None:
    """Experiments on any driver, and one report of them.

    They characterise the stage and judge the loop.
    """


@experiment.command(name="list")
@fails_clearly
def list_experiments() -> int:
    """Show every experiment and its parameters."""
    from rtloop.terminal.experiments import print_list

    print_list()
    return 0


@experiment.command()
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@CONFIG
@SET
@AXIS
@PACED
@BESIDE
@OUT
@JSON
@fails_clearly
def run(
    names: tuple[str, ...], config: Path, settings: tuple[str, ...], axis: str | None, paced: bool, beside: Path | None,
    out: Path | None, as_json: bool,
) -> int:  # fmt: skip
    """Run experiments on the driver of CONFIG, and report.

    Each is recorded. Only mode, reference and schedule are changed, and the simulated rig where an experiment is about
    that; limits and interlocks stay. Ctrl-C ramps down and reports what there is. Exit 1 where an experiment could not
    be finished.
    """
    from rtloop.commands.experiment import run_experiments

    return run_experiments(names, config, settings, axis, paced, out, as_json, beside)


@experiment.command(name="all")
@CONFIG
@SET
@AXIS
@PACED
@BESIDE
@OUT
@JSON
@fails_clearly
def run_all(
    config: Path, settings: tuple[str, ...], axis: str | None, paced: bool, beside: Path | None, out: Path | None,
    as_json: bool,
) -> int:  # fmt: skip
    """Run every experiment that the driver of CONFIG allows."""
    from rtloop.commands.experiment import run_experiments
    from rtloop.experiments.registry import EXPERIMENTS

    return run_experiments(tuple(EXPERIMENTS), config, settings, axis, paced, out, as_json, beside)


@experiment.command()
@click.argument("runs", metavar="RUN...", type=OUTPUT, nargs=-1, required=True)
@click.option("--out", type=OUTPUT, help="Folder for the report [that of the first recording].")
@JSON
@fails_clearly
def report(runs: tuple[Path, ...], out: Path | None, as_json: bool) -> int:
    """Analyse recordings of experiments again.

    RUN is a recording or a folder of them.
    """
    from rtloop.commands.experiment import report_recordings

    return report_recordings(runs, out, as_json)


experiment.add_command(
    click.Command("paper", callback=run_all.callback, params=run_all.params, help=run_all.help, hidden=True)
)
COMMANDS = (experiment,)

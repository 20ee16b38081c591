"""`rtloop init`: files to begin with, in a folder without any."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.laws import LAW_NAME
from rtloop.cli.options import OUTPUT

if TYPE_CHECKING:
    from rtloop.starters.folder import Starter

NAMES = {"law": "my_law", "driver": "my_card"}
"""Name of the law or driver if none is given; the other kinds take no name."""


@click.command()
@click.argument("folder", type=OUTPUT, default=Path())
@click.option(
    "--kind",
    type=click.Choice(["paper", "stage", "law", "driver"]),
    default="paper",
    show_default=True,
    help="The paper's loop; a simulated stage; a law; a driver.",
)
@click.option("--name", type=LAW_NAME, help="Name of the law [my_law] or driver [my_card].")
@click.option("--resonance-hz", type=float, help="Resonance of the stage, 1 to 10000 Hz [800].")
@click.option("--damping", type=float, help="Damping ratio of the resonance, 0.001 to 0.9 [0.02].")
@click.option("--range-um", type=float, help="Travel to each side, in µm: the position at the largest drive [20].")
@click.option("--drive-v", type=float, help="Largest drive, 0.1 to 10 V to each side [10].")
@click.option("--sensor-noise-um", type=float, help="Noise of the sensor, µm rms [a 4000th of the travel].")
@click.option("--sensor-resolution-um", type=float, help="Step of the sensor's reading, µm [as the noise].")
@click.option("--rate-hz", type=float, help="Rate of the loop [10000 Hz; more for a resonance above 1000 Hz].")
@report_errors
def init(folder: Path, kind: str, name: str | None, **figures: float | None) -> None:
    """Write files to begin with into FOLDER [the current folder].

    \b
    paper   the paper's loop, its specification and a campaign
    stage   a simulated stage of one resonance, its controller and a specification
    law     a controller in Python, its test and a configuration that uses it
    driver  a driver in Python as a package, its test and a configuration

    No file is overwritten: where one exists already, nothing is written.
    """
    starter = _starter(kind, name, {key: value for key, value in figures.items() if value is not None})
    from rtloop.starters.folder import write_starter

    for path in write_starter(starter, folder):
        click.echo(f"wrote {path}")
    click.echo("\nNext:")
    for command in (*(() if folder == Path() else (f"cd {folder}",)), *starter.commands):
        click.echo(f"  {command}")


def _starter(kind: str, name: str | None, figures: dict[str, float]) -> Starter:
    """Return the files of a kind. Raises UsageError for an option that belongs to another kind, or is out of range."""
    from rtloop.starters import folder
    from rtloop.starters.stage import StageFigures

    if name is not None and kind not in NAMES:
        raise click.UsageError(f"--name: not allowed with --kind {kind}; allowed with --kind law and --kind driver")
    if figures and kind != "stage":
        option = next(iter(figures)).replace("_", "-")
        raise click.UsageError(f"--{option}: not allowed with --kind {kind}; allowed with --kind stage")
    if kind == "stage":
        try:
            return folder.stage(StageFigures(**figures))
        except ValueError as error:
            raise click.UsageError(str(error)) from None
    if kind == "paper":
        return folder.paper()
    return (folder.law if kind == "law" else folder.driver)(name or NAMES[kind])

"""`rtloop init`: files to begin with, in a folder without any."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.laws import LAW_NAME, STAGE, load_stage
from rtloop.cli.options import TARGET

if TYPE_CHECKING:
    from rtloop.configuration.file import Configuration
    from rtloop.starters.folder import Starter

NAMES = {"law": "my_law", "driver": "my_card"}
"""Name of the law or driver if none is given; the other kinds take no name."""


@click.command()
@click.argument("folder", type=TARGET, default=Path())
@click.option(
    "--kind",
    type=click.Choice(["paper", "stage", "law", "driver"]),
    default="paper",
    show_default=True,
    help="Subject of the files: the paper's loop, a simulated stage, a law or a driver.",
)
@click.option("--name", type=LAW_NAME, help="Name of the law or driver.  [default: my_law or my_card]")
@STAGE
@click.option("--resonance-hz", type=float, help="Resonance of the stage, 1 to 10000 Hz.  [default: 800]")
@click.option("--damping", type=float, help="Damping ratio of the resonance, 0.001 to 0.9.  [default: 0.02]")
@click.option("--range-um", type=float, help="Position at the largest drive, reached from rest, in µm.  [default: 20]")
@click.option(
    "--gain-um-per-v",
    type=float,
    help="Position at the largest drive divided by this drive, in µm/V; replaces --range-um.",
)
@click.option("--drive-v", type=float, help="Largest drive, 0.1 to 10 V.  [default: 10]")
@click.option(
    "--drive-min-v",
    type=float,
    help="Lowest drive, in V, from minus the largest drive to 0.  [default: minus the largest drive]",
)
@click.option(
    "--hysteresis-percent",
    type=float,
    help="Largest difference between rising and falling positions at one drive, in percent of the stroke between the "
    "lowest and the largest drive, 0 to 30.  [default: 15.3]",
)
@click.option(
    "--sensor-um-per-v",
    type=float,
    help="Scale of the sensor, in µm/V; the sensor reads up to 10 V.  [default: --range-um / 4 V]",
)
@click.option(
    "--sensor-min-v",
    type=float,
    help="Lowest reading of the sensor, -10 to 0 V; the loop trips below this reading.  [default: -10]",
)
@click.option("--sensor-noise-um", type=float, help="Noise of the sensor, µm rms.  [default: --range-um / 4000]")
@click.option(
    "--sensor-noise-mv", type=float, help="Noise of the sensor's reading, mV rms; replaces --sensor-noise-um."
)
@click.option(
    "--sensor-resolution-um", type=float, help="Step of the sensor's reading, µm.  [default: the sensor's noise]"
)
@click.option(
    "--rate-hz", type=float, help="Rate of the loop, in Hz.  [default: 10000; higher for a resonance above 1000 Hz]"
)
@report_errors
def init(folder: Path, kind: str, name: str | None, config: Path | None, **figures: float | None) -> None:
    """Write files to begin with into FOLDER [the current folder].

    \b
    paper   the paper's loop, its specification and a campaign
    stage   a simulated stage of one resonance, its controller, a specification and a campaign
    law     a controller in Python, its test and a configuration that uses it (`rtloop law new` too)
    driver  a driver in Python as a package, its test and a configuration

    No file is overwritten: where one exists already, nothing is written.
    """
    if config is not None and kind != "law":
        raise click.UsageError(f"--config: not allowed with --kind {kind}; allowed with --kind law")
    stage = load_stage(config, folder)
    starter = _starter(kind, name, stage, {key: value for key, value in figures.items() if value is not None})
    from rtloop.starters.folder import write_starter

    for path in write_starter(starter, folder):
        click.echo(f"wrote {path}")
    click.echo("\nNext:")
    for command in (*(() if folder == Path() else (f"cd {folder}",)), *starter.commands):
        click.echo(f"  {command}")


def _starter(kind: str, name: str | None, stage: Configuration | None, figures: dict[str, float]) -> Starter:
    """Return the files of a kind, not yet written, and the commands that come next.

    `name` is the name of a law or driver (None: its entry in NAMES); `stage` is the configuration for a law (None: the
    paper's rig); `figures` are the given options of a stage by their names. Raises UsageError for an option that
    belongs to another kind or is out of range.
    """
    from rtloop.starters import folder
    from rtloop.starters.stage_figures import stage_figures

    if name is not None and kind not in NAMES:
        raise click.UsageError(f"--name: not allowed with --kind {kind}; allowed with --kind law and --kind driver")
    if figures and kind != "stage":
        option = next(iter(figures)).replace("_", "-")
        raise click.UsageError(f"--{option}: not allowed with --kind {kind}; allowed with --kind stage")
    if kind == "stage":
        try:
            return folder.stage(stage_figures(figures))
        except ValueError as error:
            raise click.UsageError(str(error)) from None
    if kind == "paper":
        return folder.paper()
    if kind == "driver":
        return folder.driver(name or NAMES[kind])
    return folder.law(name or NAMES[kind], stage)

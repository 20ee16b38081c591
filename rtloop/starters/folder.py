"""The files of one kind in a user's folder, the schema for editors, and the commands to begin with."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rtloop.starters.driver import driver_files
from rtloop.starters.examples import paper_files
from rtloop.starters.law import law_files
from rtloop.starters.new_files import write_new_files
from rtloop.starters.stage import stage_files
from rtloop.starters.stage_figures import StageFigures

if TYPE_CHECKING:
    from rtloop.configuration.file import Configuration

SCHEMA = "rtloop.schema.json"
SCHEMA_LINE = f"#:schema ./{SCHEMA}\n"
"""First line of a configuration, by which an editor finds the schema."""


class Starter(NamedTuple):
    """Texts by file name, and the commands to type next, in the files' folder."""

    texts: Mapping[str, str]
    commands: tuple[str, ...]


def paper() -> Starter:
    """Return files and first commands: the paper's loop, specification and campaign, and a loop of rtloop's design."""
    commands = (
        "rtloop check paper.toml",
        "rtloop run paper.toml --duration 2",
        "rtloop design synthesise paper-spec.toml --out controller.toml",
        "rtloop campaign run campaign.toml",
    )
    return Starter(paper_files(), commands)


def stage(figures: StageFigures) -> Starter:
    """Return files and first commands: a simulated stage with controller, two excitations, specification, campaign.

    The constructor of StageFigures has checked the ranges of `figures`.
    """
    texts = stage_files(figures)
    commands = (
        "rtloop check stage.toml",
        *(_first_run(texts[name]) for name in ("stage.toml", "stage-sine.toml", "stage-step.toml")),
        "rtloop design auto sine/*.mcap step/*.mcap --specs stage-spec.toml --out designed.toml",
        "rtloop design auto sine/*.mcap step/*.mcap --specs stage-spec.toml --robust --out robust.toml"
        "  # with integral action",
        "rtloop run designed.toml --duration 2",
        "rtloop campaign run stage-campaign.toml --config robust.toml  # needs pip install 'rtloop[campaign]'",
    )
    return Starter(texts, commands)


def law(name: str, stage: Configuration | None = None) -> Starter:
    """Return files and first commands: the law `name`, its test and a configuration that uses it.

    The configuration is `stage` with this controller, by default the paper's rig.
    """
    commands = (f"rtloop check {name}.toml", f"rtloop run {name}.toml --duration 2", *_test_commands(name))
    return Starter(law_files(name, stage), commands)


def driver(kind: str) -> Starter:
    """Return files and first commands: a package with the driver `kind`, its test and a configuration that uses it."""
    commands = (
        "pip install --editable .",
        "rtloop drivers",
        f"rtloop drivers --selftest {kind}.toml --loopback",
        f"rtloop run {kind}.toml --duration 2",
        *_test_commands(kind),
    )
    return Starter(driver_files(kind), commands)


def write_starter(starter: Starter, folder: Path) -> list[Path]:
    """Write all files of a starter to `folder`, which is created, and the schema SCHEMA unless this file exists.

    Returns the paths of the written files. Raises OutputError where a file of the starter exists already (none is
    written then), or if the system refuses (some may be written then).
    """
    from rtloop.configuration.schema import schema_text

    texts = {name: _add_schema_line(name, text) for name, text in starter.texts.items()}
    if not os.path.lexists(folder / SCHEMA):
        texts[SCHEMA] = schema_text()
    return write_new_files(folder, texts)


def _test_commands(name: str) -> tuple[str, str]:
    """Return two commands, to be typed in this order: install pytest, then run test_NAME.py with it."""
    return "pip install pytest", f"python -m pytest test_{name}.py"


def _first_run(text: str) -> str:
    """Return the first `rtloop run` in the comments of a configuration, which must have one."""
    return next(line.removeprefix("#").strip() for line in text.splitlines() if line.startswith("#   rtloop run "))


def _add_schema_line(name: str, text: str) -> str:
    """Return `text` with SCHEMA_LINE before it if it is a configuration without a schema line, else unchanged."""
    is_configuration = name.endswith(".toml") and "\n[loop]\n" in text and not text.startswith("#:schema")
    return SCHEMA_LINE + text if is_configuration else text

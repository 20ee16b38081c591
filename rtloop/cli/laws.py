"""`rtloop laws` and `rtloop law new`: list the laws, and write the beginning of a new one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT, TARGET, MatchingText
from rtloop.cli.output import echo_json
from rtloop.errors import ConfigError
from rtloop.workbench.tables import console, escape, table

if TYPE_CHECKING:
    from rtloop.configuration.file import Configuration

LAW_NAME = MatchingText(
    "name", r"[a-z][a-z0-9_]{0,31}", "small letters, digits and '_', a letter first, at most 32 characters"
)
"""A name that is valid for a file, a module and a class."""
STAGE = click.option(
    "--config",
    type=OUTPUT,
    metavar="STAGE.toml",
    help="Configuration, in the folder of the files, in which the law will run.  [default: the paper's rig]",
)


@click.command()
@JSON
@report_errors
def laws(as_json: bool) -> None:
    """List the shipped laws and the laws of installed packages."""
    entries = list_laws()
    echo_json({"laws": entries}) if as_json else _print_laws(entries)


@click.group()
def law() -> None:
    """Write the files of a new law."""


@law.command()
@click.argument("name", type=LAW_NAME)
@click.option("--out", type=TARGET, default=Path(), help="Folder for the three files.  [default: the current folder]")
@STAGE
@report_errors
def new(name: str, out: Path, config: Path | None) -> None:
    """Write NAME.py, its test and a configuration that uses it.

    The law in NAME.py is a PI controller that runs; docs/laws.md explains how to change it. `rtloop init --kind law`
    writes the same files and the schema for editors.
    """
    from rtloop.starters.law import law_files
    from rtloop.starters.new_files import write_new_files

    for path in write_new_files(out, law_files(name, load_stage(config, out))):
        click.echo(path)
    click.echo(f"next: rtloop check {out / name}.toml")


def load_stage(config: Path | None, folder: Path) -> Configuration | None:
    """Load the configuration in which a law of `folder` will run; None without one.

    Raises UsageError for a configuration that does not lie directly in `folder`, because its relative paths would name
    other files there; RtloopError for one that is unreadable or invalid.
    """
    if config is None:
        return None
    if config.resolve().parent != folder.resolve():
        raise click.UsageError(
            f"--config: {config} is not in {folder.resolve()}; allowed: a file directly in this folder"
        )
    from rtloop.configuration.file import load

    return load(config)


def list_laws() -> list[dict[str, object]]:
    """Return for each registered kind {kind, slot, about (the docstring's first line), shipped, problem, defined_in}.

    `slot` is "controller" or "feedforward", `defined_in` the module; `about` is None without a docstring. `problem` is
    the reason that prevents the law's use, else None; with a problem, slot and about are None. A law of another package
    is first tried in a limited process, which is killed if the law does not return.
    """
    from rtloop.laws.limited.trial import try_limited
    from rtloop.laws.registry import BUILT_IN, find_law, kinds, law_class

    entries = []
    for kind, module in kinds().items():
        is_shipped = kind in BUILT_IN
        entry: dict[str, object] = {"kind": kind, "slot": None, "about": None, "shipped": is_shipped, "problem": None}
        try:
            if not is_shipped:
                try_limited(f"law {kind!r}", find_law, kind)
            law = law_class(find_law(kind))
            about = next(iter((law.__doc__ or "").strip().splitlines()), None)
            entry |= {"slot": law.records().slot, "about": about}
        except ValueError as error:
            entry["problem"] = str(error)
        except ConfigError as error:
            entry["problem"] = "; ".join(error.faults)
        entries.append(entry | {"defined_in": module})
    return entries


def _print_laws(entries: Sequence[dict[str, Any]]) -> None:
    """Print the entries of `list_laws` as a table, and how to write a law."""
    rows = table("kind", "slot", "what it is", "comes with", words=(1, 2, 3))
    for entry in entries:
        about = f"[red]{escape(entry['problem'])}[/]" if entry["problem"] else escape(entry["about"] or "")
        origin = "rtloop" if entry["shipped"] else escape(entry["defined_in"])
        rows.add_row(entry["kind"], entry["slot"] or "", about, origin)
    console().print(rows)
    hint = '\nTo use your own law, write file = "mine.py" in [axis.controller]. To make an example: rtloop law new mine'
    console().print(escape(hint))

"""Commands about laws."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click

from rtloop.cli.options import JSON, OUTPUT, fails_clearly
from rtloop.terminal.machine import echo_json


class LawName(click.ParamType):
    """A name that a file, a module and a class can have."""

    name = "name"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """The name; a usage error where it is none."""
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,31}", value):
            self.fail(f"{value!r}: small letters, digits and _, a letter first, at most 32", param, ctx)
        return value


@click.command()
@JSON
@fails_clearly
def laws(as_json: bool) -> int:
    """List the laws there are: shipped ones, and those that installed packages bring."""
    from rtloop.commands.law import known_laws
    from rtloop.terminal.laws import print_laws

    found = known_laws()
    echo_json({"laws": found}) if as_json else print_laws(found)
    return 0


@click.group()
def law() -> None:
    """Write a law of your own."""


@law.command()
@click.argument("name", type=LawName())
@click.option("--out", type=OUTPUT, default=Path(), help="Folder for the three files [here].")
@fails_clearly
def new(name: str, out: Path) -> int:
    """Write NAME.py, its test and an example configuration.

    A PI controller to begin with, which runs as it is; docs/laws.md goes on from there.
    """
    from rtloop.commands.law import new_law

    for path in new_law(name, out):
        click.echo(str(path))
    click.echo(f"next: rtloop check {out / name}.toml")
    return 0


COMMANDS = (laws, law)

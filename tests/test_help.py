"""Help as a stranger reads it: every list of commands is whole on a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from rtloop.cli import main


def groups(command: click.Group, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the names that lead to a group of commands, and to each group within it."""
    yield path
    context = click.Context(command)
    for name in command.list_commands(context):
        subcommand = command.get_command(context, name)
        if isinstance(subcommand, click.Group):
            yield from groups(subcommand, (*path, name))


@pytest.mark.parametrize("path", list(groups(main)), ids=lambda path: " ".join(path) or "rtloop")
def test_each_command_is_described_by_a_whole_sentence(path: tuple[str, ...]) -> None:
    help_text = CliRunner().invoke(main, [*path, "--help"], terminal_width=80).output
    commands = help_text.partition("Commands:\n")[2].splitlines()
    assert commands
    assert [line for line in commands if not line.endswith(".")] == []
    assert [line for line in commands if line.endswith("...")] == []

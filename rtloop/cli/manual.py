"""`python -m rtloop.cli.manual FOLDER`: man pages of all commands, and completion scripts of bash, zsh and fish.

Both are made of the commands' own texts. FOLDER is the `share` folder of an installation.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import click
from click.shell_completion import get_completion_class

from rtloop.cli import main as rtloop
from rtloop.version import __version__
from rtloop.workbench.written_files import write_output

NAME, COMPLETION_VARIABLE = "rtloop", "_RTLOOP_COMPLETE"
COMPLETIONS = {
    "bash": "bash-completion/completions/rtloop",
    "zsh": "zsh/vendor-completions/_rtloop",
    "fish": "fish/vendor_completions.d/rtloop.fish",
}
"""File of each shell's script, in the folder where Debian's shells look for it."""


def main(folder: Path) -> None:
    """Write all man pages and completion scripts below `folder`, over existing files.

    Raises OutputError if the system refuses.
    """
    for context in commands(click.Context(rtloop, info_name=NAME)):
        name = context.command_path.replace(" ", "-")
        write_output(folder / "man" / "man1" / f"{name}.1", man_page(context).encode())
    for shell, path in COMPLETIONS.items():
        completion = get_completion_class(shell)
        if completion is not None:
            script = completion(rtloop, {}, NAME, COMPLETION_VARIABLE).source()
            write_output(folder / path, f"{script.strip()}\n".encode())


def commands(context: click.Context) -> Iterator[click.Context]:
    """Yield the context of a command, then those of all commands below it; hidden ones are left out."""
    yield context
    if isinstance(context.command, click.Group):
        for name in context.command.list_commands(context):
            command = context.command.get_command(context, name)
            if command is not None and not command.hidden:
                yield from commands(click.Context(command, parent=context, info_name=name))


def man_page(context: click.Context) -> str:
    """Return the man page of the command in a click context, in troff."""
    command, path = context.command, context.command_path
    sections = {
        "NAME": f"{_escape(path.replace(' ', '-'))} \\- {_escape(command.get_short_help_str(limit=200).rstrip('.'))}",
        "SYNOPSIS": f".B {_escape(path)}\n{_escape(' '.join(command.collect_usage_pieces(context)))}",
        "DESCRIPTION": _paragraphs(command.help or ""),
        "OPTIONS": _definitions(_option_records(context)),
        "COMMANDS": _definitions(_command_records(context)),
        "SEE ALSO": _see_also(context),
    }
    heading = f'.TH "{path.replace(" ", "-").upper()}" 1 "" "rtloop {__version__}" "rtloop"\n'
    return heading + "".join(f'.SH "{title}"\n{text}\n' for title, text in sections.items() if text)


def _option_records(context: click.Context) -> list[tuple[str, str]]:
    """Return (option with its value, help) of each option of a command, without hidden options."""
    options = (part for part in context.command.get_params(context) if isinstance(part, click.Option))
    records = (option.get_help_record(context) for option in options)
    return [record for record in records if record is not None]


def _command_records(context: click.Context) -> list[tuple[str, str]]:
    """Return (name, short help) of each command in a group, without hidden ones; [] for a command that is no group."""
    if not isinstance(context.command, click.Group):
        return []
    children = ((name, context.command.get_command(context, name)) for name in context.command.list_commands(context))
    return [(name, child.get_short_help_str(limit=200)) for name, child in children if child and not child.hidden]


def _see_also(context: click.Context) -> str:
    """Return references, in troff, to the pages of the group above a command and of the commands below it."""
    above = [context.parent.command_path] if context.parent else []
    below = [f"{context.command_path} {name}" for name, _ in _command_records(context)]
    return ",\n".join(f".BR {_escape(path.replace(' ', '-'))} (1)" for path in [*above, *below]).replace(",\n", " ,\n")


def _definitions(records: list[tuple[str, str]]) -> str:
    """Return a troff list of `records`, (term, text) each; "" without records."""
    return "\n".join(f".TP\n\\fB{_escape(term)}\\fR\n{_escape(text)}" for term, text in records)


def _paragraphs(text: str) -> str:
    """Return a docstring in troff: paragraphs are filled, those behind click's mark \\b keep their lines."""
    parts = []
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        lines = paragraph.split("\n")
        if lines[0].strip() == "\b":
            parts.append(".PP\n.nf\n" + _escape(dedent("\n".join(lines[1:]))) + "\n.fi")
        else:
            parts.append(".PP\n" + _escape(" ".join(line.strip() for line in lines)))
    return "\n".join(parts)


def _escape(text: str) -> str:
    """Return text with backslashes, hyphens, and a dot or apostrophe at the start of a line, escaped for troff."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return "\n".join(f"\\&{line}" if line.startswith((".", "'")) else line for line in text.split("\n"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

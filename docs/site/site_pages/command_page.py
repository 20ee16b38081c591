"""Page of all commands with their arguments and options, from click."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

import click

from rtloop.cli import main
from site_pages.texts import anchored, escape, table


def commands(command: click.Command, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Yield (words, command) of a command and of all commands below it that are not hidden."""
    yield path, command
    if isinstance(command, click.Group):
        for name in sorted(command.commands):
            if not command.commands[name].hidden:
                yield from commands(command.commands[name], (*path, name))


def command_page() -> str:
    """Return the page of all commands."""
    parts = [
        "# Commands\n\nEvery command takes `--help`. Commands that print figures take `--json`, which prints one JSON "
        "object for a script."
    ]
    for path, command in commands(main, ("rtloop",)):
        parts.append(_command_markdown(path, command))
    return "\n\n".join(parts)


def _command_markdown(path: tuple[str, ...], command: click.Command) -> str:
    """Return heading, usage, help text and options of one command."""
    context = click.Context(command, info_name=" ".join(path))
    level = "##" if len(path) <= 2 else "###"
    lines = [
        f"{level} `{' '.join(path)}` {{ #{'-'.join(path)} }}",
        "",
        *_help_text(inspect.cleandoc(command.help or "")),
    ]
    usage = " ".join([*path, *command.collect_usage_pieces(context)])
    lines += ["", "```text", usage, "```"]
    rows = [
        _option_row(path, parameter, context)
        for parameter in command.get_params(context)
        if isinstance(parameter, click.Option) and not parameter.hidden and "--help" not in parameter.opts
    ]
    return "\n".join(lines) + "\n" + table(("option", "value", "default", "meaning"), rows)


def _help_text(text: str) -> Iterator[str]:
    """Yield the lines of a help text as Markdown; paragraphs that click prints as they stand become blocks of code."""
    for paragraph in re.split(r"\n\s*\n", text.split("\f")[0]):
        if not paragraph.startswith("\b"):
            yield escape(paragraph)
        else:
            lines = paragraph.strip("\b\n").splitlines()
            if lines and not lines[0].startswith(" ") and any(line.startswith("  ") for line in lines[1:]):
                yield escape(lines.pop(0))
                yield ""
            yield from ("```text", *lines, "```")
        yield ""


def _option_row(path: tuple[str, ...], option: click.Option, context: click.Context) -> tuple[str, ...]:
    """Return the cells of one option."""
    names = ", ".join([*option.opts, *option.secondary_opts])
    anchor = "-".join((*path, option.opts[-1].strip("-")))
    extra = option.get_help_extra(context)
    value = "" if option.is_flag or option.count else f"`{option.make_metavar(context)}`"
    if limits := extra.get("range", ""):
        value += f" {limits.replace('<', '&lt;')}"
    if option.multiple:
        value += " (repeatable)"
    default = option.get_default(context)
    shown = "**required**" if option.required else extra.get("default", "")
    if not shown and isinstance(default, int | float | str) and not isinstance(default, bool) and default != "":
        shown = str(default)
    return anchored(names, anchor), value, shown, escape(" ".join((option.help or "").split()))

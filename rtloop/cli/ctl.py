"""`rtloop ctl`: what a running service is told, and asked."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from rtloop.cli.options import JSON, OUTPUT, InputFile, fails_clearly
from rtloop.terminal.machine import echo_json

SECTION = click.Choice(["controller", "limits", "interlocks", "prefilter", "model"])


@click.group()
@click.option("--name", help="Name of the service: that of its configuration file [the only one running].")
@click.option("--socket", "socket_path", type=OUTPUT, help="Path of its control socket.")
@click.option("--as", "as_name", metavar="NAME", help="Who drives, and is recorded [operator].")
@click.pass_context
def ctl(context: click.Context, name: str | None, socket_path: Path | None, as_name: str | None) -> None:
    """Talk to a running service. Answers are JSON.

    One drives: while somebody else does, all that moves or changes something is refused but stop.
    """
    context.obj = (name, socket_path, as_name)


def client_of(context: click.Context) -> Any:
    """Of the service that `ctl` was asked to talk to. Raises UnavailableError."""
    from rtloop.service.client import Client
    from rtloop.service.client.control_socket import find_control_socket

    name, path, as_name = context.obj
    return Client(path or find_control_socket(name), as_name)


def _post(name: str, help_text: str) -> None:
    @ctl.command(name, help=help_text)
    @click.pass_context
    @fails_clearly
    def command(context: click.Context) -> int:
        echo_json(client_of(context).post(f"/{name}"))
        return 0


for _name, _help in (
    ("arm", "Allow the outputs to be driven."),
    ("start", "Set the configured mode."),
    ("stop", "Ramp the outputs to safe and stay there."),
    ("reset", "Forget latched trips; the outputs stay off."),
    ("reload", "Read the configuration again."),
):
    _post(_name, _help)


@ctl.command()
@click.option(
    "--break", "breaks", is_flag=True, help="From whoever holds it, by the emergency key, which is asked for."
)
@click.pass_context
@fails_clearly
def lock(context: click.Context, breaks: bool) -> int:
    """Take the lock before the first command does."""
    key = None
    if breaks:
        at_terminal = sys.stdin.isatty()
        key = click.prompt("emergency key", hide_input=True, err=True) if at_terminal else sys.stdin.readline().strip()
    echo_json(client_of(context).lock(key))
    return 0


@ctl.command()
@click.pass_context
@fails_clearly
def release(context: click.Context) -> int:
    """Release the lock: somebody else may drive."""
    echo_json(client_of(context).delete("/lock"))
    return 0


@ctl.command()
@click.pass_context
@fails_clearly
def status(context: click.Context) -> int:
    """State, who drives, rate, lateness, faults and the newest signals."""
    echo_json(client_of(context).get("/status"), indent=2)
    return 0


@ctl.command()
@click.pass_context
@fails_clearly
def metrics(context: click.Context) -> int:
    """Metrics in Prometheus' text format."""
    click.echo(client_of(context).get("/metrics"), nl=False)
    return 0


@ctl.command()
@click.option("--count", type=click.IntRange(1), help="End after so many lines.")
@click.pass_context
@fails_clearly
def watch(context: click.Context, count: int | None) -> int:
    """Newest signals, a line of JSON 20 times a second."""
    for number, line in enumerate(client_of(context).watch(), start=1):
        echo_json(line)
        if number == count:
            break
    return 0


@ctl.command()
@click.argument("mode", type=click.Choice(["off", "raw", "feedforward", "closed_loop"]))
@click.pass_context
@fails_clearly
def mode(context: click.Context, mode: str) -> int:
    """Change the mode of all axes, bumplessly."""
    echo_json(client_of(context).post("/mode", {"mode": mode}))
    return 0


@ctl.command(context_settings={"ignore_unknown_options": True})  # -5 is a number
@click.argument("axis")
@click.argument("value", type=float)
@click.pass_context
@fails_clearly
def setpoint(context: click.Context, axis: str, value: float) -> int:
    """Hold the reference of AXIS at VALUE, in µm (V in raw mode)."""
    echo_json(client_of(context).post("/setpoint", {"axis": axis, "value": value}))
    return 0


@ctl.command()
@click.argument("axis")
@click.argument("reference")
@click.pass_context
@fails_clearly
def reference(context: click.Context, axis: str, reference: str) -> int:
    """Change the reference of AXIS.

    As in [axis.reference]: 'kind = "sine", amplitude = 5.0, frequency_hz = 2.0'.
    """
    body = {"axis": axis, "reference": _inline_table(reference)}
    echo_json(client_of(context).post("/reference", body))
    return 0


@ctl.command()
@click.argument("axis")
@click.argument("file", type=InputFile())
@click.option("--hold-ticks", default=1, show_default=True, type=click.IntRange(1))
@click.option("--repeat", is_flag=True)
@click.pass_context
@fails_clearly
def waveform(context: click.Context, axis: str, file: Any, hold_ticks: int, repeat: bool) -> int:
    """Play the numbers in FILE, one to a line, on AXIS; a second one is added to the command, in µm."""
    columns = [list(column) for column in zip(*numbers_in(file), strict=True)] or [[]]
    body = {"axis": axis, "samples": columns[0], "hold_ticks": hold_ticks, "repeat": repeat}
    if len(columns) > 1:
        body["command_um"] = columns[1]
    echo_json(client_of(context).post("/waveform", body))
    return 0


@ctl.command()
@click.argument("axis")
@click.argument("section", type=SECTION)
@click.argument("values")
@click.pass_context
@fails_clearly
def tune(context: click.Context, axis: str, section: str, values: str) -> int:
    """Change keys of [axis.SECTION] of AXIS.

    For example 'gain = 0.012' or 'position_um = 50.0, sensor_max_v = 9.0'.
    """
    echo_json(_answer(context, "/tune", axis, section, values))
    return 0


@ctl.command()
@click.argument("axis")
@click.argument("section", type=SECTION)
@click.argument("values")
@JSON
@click.pass_context
@fails_clearly
def preview(context: click.Context, axis: str, section: str, values: str, as_json: bool) -> int:
    """Show the margins, step and tolerated shift that `tune` would give AXIS; changes nothing.

    A table on a terminal, JSON elsewhere.
    """
    from rtloop.terminal.preview import print_preview

    figures = _answer(context, "/preview", axis, section, values)
    if as_json or not sys.stdout.isatty():
        echo_json(figures)
    else:
        print_preview(axis, figures)
    return 0


def _answer(context: click.Context, resource: str, axis: str, section: str, values: str) -> Any:
    """Post keys of [axis.SECTION] to a resource of the service. Returns its answer. Raises click.UsageError."""
    body = {"axis": axis, "section": section, "values": _inline_table(values)}
    return client_of(context).post(resource, body)


@ctl.command()
@click.argument("axis")
@click.pass_context
@fails_clearly
def undo(context: click.Context, axis: str) -> int:
    """Go back to before the last change of AXIS by tune or controller, bumplessly."""
    echo_json(client_of(context).post("/undo", {"axis": axis}))
    return 0


@ctl.command()
@click.argument("axis")
@click.argument("config", type=OUTPUT)
@click.pass_context
@fails_clearly
def controller(context: click.Context, axis: str, config: Path) -> int:
    """Swap in the controller of another configuration.

    FILE's [axis.controller] of that axis is verified first.
    """
    from rtloop.configuration.file import load

    axes = {one.name: one for one in load(config).axes}
    if axis not in axes or axes[axis].controller is None:
        has = f"axis {axis} has none" if axis in axes else f"its axes are {', '.join(axes)}"
        raise click.UsageError(f"{config}: no controller for axis {axis!r}; {has}")
    section = axes[axis].controller
    assert section is not None
    body = {"axis": axis, "controller": section.model_dump(exclude_unset=True)}
    echo_json(client_of(context).post("/controller", body))
    return 0


def numbers_in(file: Any) -> list[list[float]]:
    """One to a line, or two; empty lines are left out. Raises a usage error."""
    found: list[list[float]] = []
    for number, line in enumerate(file, start=1):
        try:
            numbers = [float(part) for part in line.replace(",", " ").split()]
        except ValueError:
            raise click.UsageError(f"{file.name}, line {number}: {line.strip()!r}; a number is needed") from None
        found += [numbers] if numbers else []
        if numbers and (len(numbers) > 2 or len(numbers) != len(found[0])):
            said = f"{file.name}, line {number}: {len(numbers)} numbers"
            raise click.UsageError(f"{said}; one to a line, or two to each, are needed")
    return found


def _inline_table(text: str) -> dict[str, Any]:
    """TOML's inline table without its braces. Raises a usage error, with no place in a text that nobody typed."""
    from rtloop.configuration.text_files import parse_toml

    try:
        return parse_toml(f"table = {{ {text} }}")["table"]
    except ValueError:
        raise click.UsageError(f"{text!r}: `key = value, key = value` is needed, values as in TOML") from None


COMMANDS = (ctl,)

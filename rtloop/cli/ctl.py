"""`rtloop ctl`: requests to a running service."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import JSON, OUTPUT, InputFile
from rtloop.cli.output import echo_json
from rtloop.workbench.tables import console, format_number, print_problems, table

if TYPE_CHECKING:
    from rtloop.client import Client

FIGURES = (
    ("crossover", "crossover_hz", "Hz"),
    ("phase margin", "phase_margin_deg", "°"),
    ("gain margin", "gain_margin_db", "dB"),
    ("modulus margin", "modulus_margin", ""),
    ("static error", "static_error_percent", "%"),
    ("settling (5 %)", "settling_ms", "ms"),
    ("overshoot", "overshoot_percent", "%"),
)
AXIS = click.argument("axis")
SECTION = click.argument("section", type=click.Choice(["controller", "limits", "interlocks", "prefilter", "model"]))


@click.group()
@click.option("--name", help="Name of the service, such as NAME for NAME.toml.  [default: the only running service]")
@click.option("--socket", "socket_path", type=OUTPUT, help="Path of the service's control socket, instead of --name.")
@click.option(
    "--as",
    "as_name",
    metavar="NAME",
    help="Name under which your commands are recorded and hold the lock.  [default: operator]",
)
@click.pass_context
def ctl(context: click.Context, name: str | None, socket_path: Path | None, as_name: str | None) -> None:
    """Send requests to a running service.

    Prints each response as JSON; on a terminal, an empty response as a sentence. Only the lock holder may move or
    change the loop; anyone may stop it.
    """
    context.obj = (name, socket_path, as_name)


def make_client(context: click.Context) -> Client:
    """Return a client of the service that the options of `ctl` name; no request is sent yet.

    Raises UnavailableError if no control socket has that name; without a name, if there is none or more than one.
    """
    from rtloop.client import Client
    from rtloop.client.control_socket import find_control_socket

    name, path, as_name = context.obj
    return Client(path or find_control_socket(name), as_name)


def print_response(response: object, sentence: str) -> None:
    """Print a response as JSON; on a terminal, print `sentence`, unless it is "", instead of an empty response {}."""
    if response == {} and sentence and sys.stdout.isatty():
        click.echo(sentence)
    else:
        echo_json(response)


def post(
    resource: str, sentence: str = ""
) -> Callable[[Callable[..., Mapping[str, object] | None]], Callable[..., None]]:
    """Return a decorator that turns a function into a command: the function makes a request's body from the command's
    options, the command posts this body to `resource` and prints the response.

    `sentence` is printed on a terminal for an empty response, as in `print_response`.
    """

    def decorate(make_body: Callable[..., Mapping[str, object] | None]) -> Callable[..., None]:
        """Return the command that posts the body that `make_body` returns for the command's options."""

        @click.pass_context
        @report_errors
        @wraps(make_body)
        def command(context: click.Context, **options: object) -> None:
            """Post the body that belongs to the options, and print the response."""
            body = make_body(**options)
            print_response(make_client(context).post(resource, body), sentence)

        return command

    return decorate


for _name, _help, _sentence in (
    (
        "arm",
        "Allow the outputs to be driven.",
        "armed: the outputs may be driven; `rtloop ctl start` sets the configured mode",
    ),
    ("start", "Set the mode that the configuration states, loop.mode.", ""),
    ("stop", "Ramp the outputs to their safe values.", ""),
    ("reset", "Clear latched trips; the outputs stay off.", ""),
    ("reload", "Read the configuration file again and apply it.", ""),
):
    ctl.command(_name, help=_help)(post(f"/{_name}", _sentence)(lambda: None))


@ctl.command()
@click.option(
    "--break", "breaks", is_flag=True, help="Take the lock from its holder; the command asks for the emergency key."
)
@click.pass_context
@report_errors
def lock(context: click.Context, breaks: bool) -> None:
    """Take the lock now; otherwise the first command takes it."""
    key = None
    if breaks:
        at_terminal = sys.stdin.isatty()
        key = click.prompt("emergency key", hide_input=True, err=True) if at_terminal else sys.stdin.readline().strip()
    echo_json(make_client(context).lock(key))


@ctl.command()
@click.pass_context
@report_errors
def release(context: click.Context) -> None:
    """Release the lock, so that another client may take it."""
    print_response(make_client(context).delete("/lock"), "the lock is free")


@ctl.command()
@click.pass_context
@report_errors
def status(context: click.Context) -> None:
    """Show state, lock holder, faults and newest signals."""
    echo_json(make_client(context).get("/status"), indent=2)


@ctl.command()
@click.pass_context
@report_errors
def metrics(context: click.Context) -> None:
    """Show metrics in Prometheus' text format."""
    click.echo(make_client(context).get("/metrics"), nl=False)


@ctl.command()
@click.option("--count", type=click.IntRange(1), help="Number of lines to print.  [default: all until Ctrl-C]")
@click.pass_context
@report_errors
def watch(context: click.Context, count: int | None) -> None:
    """Print state and newest signals, 20 lines of JSON a second.

    Each line also has the faults, the lock and a measurement in progress. Ends with the service.
    """
    for number, line in enumerate(make_client(context).watch(), start=1):
        echo_json(line)
        if number == count:
            break


@ctl.command()
@click.argument("mode", type=click.Choice(["off", "raw", "feedforward", "closed_loop"]))
@post("/mode")
def mode(mode: str) -> dict[str, object]:
    """Change the mode of all axes, bumplessly."""
    return {"mode": mode}


@ctl.command(context_settings={"ignore_unknown_options": True})  # -5 is a number
@AXIS
@click.argument("value", type=float)
@post("/setpoint")
def setpoint(axis: str, value: float) -> dict[str, object]:
    """Hold the reference of AXIS at VALUE, in µm (V in raw mode)."""
    return {"axis": axis, "value": value}


@ctl.command()
@AXIS
@click.argument("reference")
@post("/reference")
def reference(axis: str, reference: str) -> dict[str, object]:
    """Change the reference of AXIS.

    REFERENCE has the keys of [axis.reference]: 'kind = "sine", amplitude = 5.0, frequency_hz = 2.0'.
    """
    return {"axis": axis, "reference": _parse_inline_table(reference)}


@ctl.command()
@AXIS
@click.argument("file", type=InputFile())
@click.option(
    "--hold-ticks", default=1, show_default=True, type=click.IntRange(1), help="Ticks for which each number is held."
)
@click.option("--repeat", is_flag=True, help="Play FILE again and again.")
@post("/waveform")
def waveform(axis: str, file: IO[str], hold_ticks: int, repeat: bool) -> dict[str, object]:
    """Play the numbers in FILE as the reference of AXIS.

    FILE has one number a line, in µm (V in raw mode). A second column, in µm, is added to the command. The last number
    is held, unless --repeat is used.
    """
    columns = [list(column) for column in zip(*read_numbers(file), strict=True)] or [[]]
    body: dict[str, object] = {"axis": axis, "samples": columns[0], "hold_ticks": hold_ticks, "repeat": repeat}
    return body if len(columns) == 1 else {**body, "command_um": columns[1]}


@ctl.command()
@AXIS
@SECTION
@click.argument("values")
@post("/tune")
def tune(axis: str, section: str, values: str) -> dict[str, object]:
    """Change keys of [axis.SECTION] of AXIS.

    For example 'gain = 0.012' or 'position_um = 50.0, sensor_max_v = 9.0'.
    """
    return {"axis": axis, "section": section, "values": _parse_inline_table(values)}


@ctl.command()
@AXIS
@SECTION
@click.argument("values")
@JSON
@click.pass_context
@report_errors
def preview(context: click.Context, axis: str, section: str, values: str, as_json: bool) -> None:
    """Show the effect of `tune` on AXIS, without changing it.

    Prints margins, step and tolerated shift of the resonance: a table on a terminal, JSON elsewhere.
    """
    body = {"axis": axis, "section": section, "values": _parse_inline_table(values)}
    figures = make_client(context).post("/preview", body)
    if as_json or not sys.stdout.isatty():
        echo_json(figures)
    else:
        print_preview(axis, figures)


@ctl.command()
@AXIS
@post("/undo")
def undo(axis: str) -> dict[str, object]:
    """Undo the last change of AXIS by tune or controller."""
    return {"axis": axis}


@ctl.command()
@AXIS
@click.argument("config", type=OUTPUT)
@post("/controller")
def controller(axis: str, config: Path) -> dict[str, object]:
    """Swap in the controller of another configuration.

    The [axis.controller] of AXIS in CONFIG is verified first.
    """
    from rtloop.client.connection import read_controller

    return {"axis": axis, "controller": read_controller(config, axis)}


def read_numbers(file: IO[str]) -> list[list[float]]:
    """Return the rows of an open file: one number each, or two each (comma or spaces); empty lines are skipped.

    Returns [] for a file without numbers. Raises click.UsageError for other text, for a row of more than two numbers,
    and for rows of different lengths.
    """
    rows: list[list[float]] = []
    for number, line in enumerate(file, start=1):
        try:
            numbers = [float(part) for part in line.replace(",", " ").split()]
        except ValueError:
            raise click.UsageError(f"{file.name}, line {number}: {line.strip()!r}; allowed: numbers") from None
        rows += [numbers] if numbers else []
        if numbers and (len(numbers) > 2 or len(numbers) != len(rows[0])):
            fault = f"{file.name}, line {number}: {len(numbers)} numbers"
            raise click.UsageError(f"{fault}; allowed: one number in every line, or two numbers in every line")
    return rows


def _parse_inline_table(text: str) -> dict[str, object]:
    """Return `key = value, key = value`, the inside of a TOML inline table, as a dict.

    Raises click.UsageError for any other text.
    """
    from rtloop.configuration.text_files import parse_toml

    try:
        return parse_toml(f"table = {{ {text} }}")["table"]
    except ValueError:
        raise click.UsageError(
            f"{text!r} is no list of keys; allowed: `key = value, key = value`, with values as in TOML"
        ) from None


def print_preview(axis: str, answer: dict[str, Any]) -> None:
    """Print `answer`, a response of `/preview`: figures of the running loop and after the change, and the problems of
    the change.
    """
    out, before, after = console(), answer["before"], answer["after"]
    rows = table(f"axis {axis}, on the model", "now", "after the change", "")
    for label, key, unit in FIGURES:
        rows.add_row(label, format_number(before[key]), format_number(after[key]), unit)
    rows.add_row("resonance may move by", _format_shift(before), _format_shift(after), "%")
    out.print(rows)
    print_problems(out, after["problems"])


def _format_shift(figures: dict[str, Any]) -> str:
    """Return the shifts of the resonance that a loop tolerates, in %, as text: "-3.0 … +4.5"; "–" if they are None.

    `figures` are the loop's figures in a response of `/preview`.
    """
    shift = figures["tolerated_shift_percent"]
    return "–" if shift is None else f"{shift[0]:+.1f} … {shift[1]:+.1f}"

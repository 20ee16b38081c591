"""`rtloop serve`, `rtloop park`, `rtloop hil serve`: the daemon, parking, and the simulated rig as a process."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import CONFIG, MatchingText
from rtloop.cli.panel import panel_options, panel_process, terminate_at_stdin_end
from rtloop.errors import ConfigError, UnavailableError
from rtloop.values import count_text

if TYPE_CHECKING:
    from rtloop.configuration.file import Configuration
    from rtloop.drivers.can.options import CanOptions
    from rtloop.drivers.node.options import NodeOptions


BOARD_PRIORITY = 85
SERVICE_NAME = MatchingText(
    "text",
    r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}",
    "letters, digits, '.', '_' and '-', a letter or digit first, at most 64 characters",
)
"""A plain file name, since socket and shared block of a service are files of its name."""


@click.command()
@CONFIG
@click.option(
    "--name",
    type=SERVICE_NAME,
    help="Name of the service, which `rtloop ctl --name` uses.  [default: NAME for NAME.toml]",
)
@panel_options
@report_errors
def serve(config: Path, name: str | None, panel: bool, panel_port: int) -> int:
    """Run the loop of CONFIG as a daemon with a control API.

    The daemon reports its state to systemd, and ends at SIGTERM or SIGINT.
    """
    from rtloop.service.daemon import serve as serve_configuration

    with panel_process(config, panel, panel_port, name):
        return serve_configuration(config, name=name)


@click.command()
@CONFIG
@click.option(
    "--name",
    type=SERVICE_NAME,
    help="Name of the service, as in `rtloop serve --name`.  [default: NAME for NAME.toml]",
)
@report_errors
def park(config: Path, name: str | None) -> None:
    """Ramp every output of CONFIG to its safe value."""
    from rtloop.supervision.parking import park_configuration

    click.echo(park_configuration(config, name), err=True)


@click.group()
def hil() -> None:
    """Run the simulated rig as a separate process."""


@hil.command("serve")
@CONFIG
@click.option("--can", "on_can", is_flag=True, help="Simulate the node on the CAN bus of CONFIG (driver.kind = 'can').")
@click.option(
    "--udp", "on_udp", is_flag=True, help="Simulate the node at the UDP address of CONFIG (driver.kind = 'udp')."
)
@click.option(
    "--serial", "on_serial", is_flag=True, help="Simulate the node on a pseudo-terminal (driver.kind = 'serial')."
)
@click.option("--until-stdin-ends", "tied", is_flag=True, hidden=True)
@report_errors
def hil_serve(config: Path, on_can: bool, on_udp: bool, on_serial: bool, tied: bool) -> None:
    """Simulate the board or the node of CONFIG.

    The board (driver.kind = 'shm') is a simulated rig with its own clock. The board keeps running when a loop that
    drives it ends.
    """
    from rtloop.configuration.file import load

    configuration = load(config)
    outputs = {axis: channels.output for axis, channels in configuration.wiring.items()}
    axes = sorted(outputs, key=lambda axis: (len(outputs[axis]), outputs[axis]))  # dac10 comes after dac9.
    options = {"can": on_can, "udp": on_udp, "serial": on_serial}
    if sum(options.values()) > 1:
        raise click.UsageError(
            "--can, --udp and --serial: more than one of these options is given; allowed: one of them"
        )
    line = next((name for name, is_chosen in options.items() if is_chosen), None)
    is_stopped = _watch_stop_signals()
    if tied:
        terminate_at_stdin_end()
    if line is None:
        _serve_board(configuration, axes, is_stopped)
    else:
        _serve_node(configuration, line, axes, is_stopped)


def _serve_board(configuration: Configuration, axes: list[str], is_stopped: Callable[[], bool]) -> None:
    """Be the simulated board of a configuration with driver 'shm' until `is_stopped()` is True.

    Tells systemd when the board is ready. `axes` are the names of the axes in the order of outputs. Requests real-time
    priority, and runs without it if the kernel refuses. Raises ConfigError for a driver other than 'shm' or invalid
    options, UnavailableError if the system refuses the block's file or another board serves this file.
    """
    from rtloop.drivers.shm import ShmOptions
    from rtloop.engine.plan import Pacing
    from rtloop.engine.realtime import prepare_realtime
    from rtloop.hil.board import serve
    from rtloop.service.notify import Notifier

    options, source = configuration.driver_options, configuration.source
    if not isinstance(options, ShmOptions):
        nodes = "'can' for `rtloop hil serve --can`, 'udp' with --udp, 'serial' with --serial"
        allowed = f"'shm' for `rtloop hil serve`, {nodes}"
        raise ConfigError(source, [f"driver.kind: value is {configuration.driver_kind!r}; allowed: {allowed}"])
    rate_hz = options.board_rate_hz or configuration.loop.rate_hz
    prepare_realtime(Pacing(rate_hz, priority=BOARD_PRIORITY))
    extent = f"{count_text(len(axes), 'channel')} at {rate_hz:g} Hz"
    click.echo(f"the simulated board runs, {extent}, in shared memory {options.file}; Ctrl-C ends the board", err=True)
    try:
        samples = serve(Path(options.file), options, axes, rate_hz, is_stopped, lambda: Notifier().send(READY=1))
    except ValueError as error:
        raise ConfigError(source, [f"driver: {error}"]) from None
    except OSError as error:
        raise UnavailableError(f"{options.file}: {error.strerror or error}") from None
    click.echo(f"board at {options.file}: ended after {samples} samples", err=True)


def _serve_node(configuration: Configuration, line: str, axes: list[str], is_stopped: Callable[[], bool]) -> None:
    """Be the simulated node of a configuration's [driver], with `axes` in the order of outputs, until `is_stopped()`.

    `line` is the driver's kind: "can", "udp" or "serial". Requests real-time priority for this process, prints a line
    at the start and the node's counts at the end, and tells systemd when the node is ready. Raises ConfigError for a
    driver of another kind or invalid options, DriverError for a line that cannot be opened or fails, and for another
    node on a CAN bus.
    """
    from rtloop.drivers.can.options import CanOptions
    from rtloop.drivers.node.options import NodeOptions
    from rtloop.engine.plan import Pacing
    from rtloop.engine.realtime import prepare_realtime
    from rtloop.service.notify import Notifier

    options, source = configuration.driver_options, configuration.source
    if configuration.driver_kind != line:
        raise ConfigError(
            source, [f"driver.kind: value is {configuration.driver_kind!r}; allowed with --{line}: {line!r}"]
        )
    if not isinstance(options, CanOptions | NodeOptions):
        raise TypeError(
            f"driver.kind: {line!r} has options of class {type(options).__name__}; allowed: CanOptions or NodeOptions"
        )
    prepare_realtime(Pacing(configuration.loop.rate_hz, priority=BOARD_PRIORITY))

    def announce() -> None:
        """Print that the node runs, and notify systemd."""
        click.echo(f"node on {options.label}: {count_text(len(axes), 'channel')}; Ctrl-C ends the node", err=True)
        Notifier().send(READY=1)

    serve = _node_program(options)
    try:
        account = serve(options, axes, is_stopped, announce)
    except ValueError as error:
        raise ConfigError(source, [f"driver.{error}"]) from None
    click.echo(f"node on {options.label}: {account}", err=True)


def _node_program(options: CanOptions | NodeOptions) -> Callable[..., str]:
    """Return the function `serve(options, axes, is_stopped, on_ready)` that runs a node with options of this class.

    `serve` returns a sentence with the node's counts when `is_stopped()` is True.
    """
    from rtloop.drivers.can.options import CanOptions

    if isinstance(options, CanOptions):
        from rtloop.drivers.can.node import serve
    else:
        from rtloop.drivers.node.serving import serve
    return serve


def _watch_stop_signals() -> Callable[[], bool]:
    """Catch SIGINT and SIGTERM from now on. Returns a function that returns whether one of them has come."""
    has_stopped = False

    def stop(*_: object) -> None:
        """Handle a signal: store that it has come."""
        nonlocal has_stopped
        has_stopped = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return lambda: has_stopped

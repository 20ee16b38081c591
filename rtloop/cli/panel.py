"""`rtloop panel`: a running loop in the browser."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import TARGET, MatchingText
from rtloop.errors import RtloopError

PORT = 8321
LOOPBACK = MatchingText("address", r"127(\.(25[0-5]|2[0-4]\d|1?\d?\d)){3}", "an address of this host alone, 127.x.x.x")


def port_option(name: str) -> Callable[[Callable[..., object]], Callable[..., object]]:
    """Return a decorator that adds the option `name` to a command: the TCP port of the panel, PORT by default."""
    return click.option(
        name,
        type=click.IntRange(0, 65535),
        default=PORT,
        show_default=True,
        help="Port of the panel; 0: any free port.",
    )


def panel_options(command: Callable[..., object]) -> Callable[..., object]:
    """Add --panel and --panel-port to a command that can start the panel as a second process. Returns the command."""
    return click.option("--panel", is_flag=True, help="Start `rtloop panel` as well, to show the loop in the browser.")(
        port_option("--panel-port")(command)
    )


def panel_process(config: Path, enabled: bool, port: int, name: str | None = None) -> AbstractContextManager[None]:
    """Return a context that runs the panel of a configuration's service in a second process, until the context ends.

    Without `enabled`, the context has no effect. `name` is the service's name, None: the configuration's name. The call
    of this function, not the context, raises ConfigError for an invalid configuration and InputFileError for a
    configuration that cannot be read.
    """
    if not enabled:
        return nullcontext()
    from rtloop.configuration.file import load
    from rtloop.panel.web.panel_process import run_panel_process
    from rtloop.supervision.paths import socket_path

    return run_panel_process(socket_path(load(config, name)), port)


@click.command()
@click.argument("service", metavar="[NAME|SOCKET]", required=False)
@port_option("--port")
@click.option("--address", type=LOOPBACK,
              help="Address of the panel in 127.0.0.0/8.  [default: another one at each start]")  # fmt: skip
@click.option("--open", "opens", is_flag=True, help="Open the panel in the browser.")
@click.option(
    "--token-file", type=TARGET, help="File that receives the address with the token, which is then not printed."
)
@click.option(
    "--foxglove", is_flag=True, help="Serve Foxglove viewers (WebSocket) too; these viewers cannot control the loop."
)
@click.option("--until-stdin-ends", "tied", is_flag=True, hidden=True)
@report_errors
def panel(
    service: str | None,
    port: int,
    address: str | None,
    opens: bool,
    token_file: Path | None,
    foxglove: bool,
    tied: bool,
) -> int:
    """Show and drive a running loop in the browser.

    NAME is the name of a service, SOCKET the path of its control socket; without either, the only running service is
    used. The panel is a separate process; no tick waits for it. The panel listens on an address of this host that no
    other host reaches.
    """
    from rtloop.client import Client
    from rtloop.client.control_socket import find_control_socket
    from rtloop.panel.web.server import serve

    path = Path(service) if service is not None and "/" in service else find_control_socket(service)
    if tied:
        terminate_at_stdin_end()
    else:  # started by hand: a service that starts its own panel is not there yet
        try:
            Client(path).get("/status")
        except RtloopError as error:
            click.echo(f"{error}; the panel waits for the service", err=True)
    return serve(path, port, token_file, lambda text: click.echo(f"panel: {text}", err=True), opens, foxglove, address)


def terminate_at_stdin_end() -> None:
    """Start a daemon thread that sends SIGTERM to this process once the parent has closed its end of stdin."""

    def wait() -> None:
        """Wait for the end of stdin, then send SIGTERM to this process."""
        while os.read(0, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()

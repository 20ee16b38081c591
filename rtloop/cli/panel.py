"""The command of the panel: a running loop in the browser."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import click

from rtloop.cli.options import OUTPUT, fails_clearly

PORT = 8321


def with_panel(command: Any) -> Any:
    """The options of a command that can have a panel beside it."""
    port = click.option(
        "--panel-port", type=click.IntRange(0, 65535), default=PORT, show_default=True, help="Of the panel; 0 is any."
    )
    return click.option("--panel", is_flag=True, help="Show it in the browser: `rtloop panel` beside it.")(
        port(command)
    )


def beside(config: Path, wanted: bool, port: int, name: str | None = None) -> AbstractContextManager[None]:
    """The panel of the service of a configuration, where it is wanted. Raises ConfigError."""
    if not wanted:
        return nullcontext()
    from rtloop.configuration.file import load
    from rtloop.panel.process import run_panel_process
    from rtloop.supervision.paths import socket_path

    return run_panel_process(socket_path(load(config, name)), port)


@click.command()
@click.argument("service", metavar="[NAME|SOCKET]", required=False)
@click.option("--port", default=PORT, show_default=True, type=click.IntRange(0, 65535), help="0 is any free one.")
@click.option("--open", "opens", is_flag=True, help="Open it in the browser.")
@click.option("--token-file", type=OUTPUT, help="Holds the token, and is made where it is not there.")
@click.option("--foxglove", is_flag=True, help="Serve viewers of the Foxglove WebSocket protocol; they can only look.")
@click.option("--until-stdin-ends", "tied", is_flag=True, hidden=True)
@fails_clearly
def panel(service: str | None, port: int, opens: bool, token_file: Path | None, foxglove: bool, tied: bool) -> int:
    """Show a running loop in the browser: a scope, a spectrum, a desk.

    NAME is that of a service, SOCKET the path of its control socket; the only service that runs is taken without
    either. The panel is a process of its own, and whatever becomes of it, no tick waits. It listens on 127.0.0.1 alone.
    """
    from rtloop.panel.web.server import serve
    from rtloop.service.client.control_socket import find_control_socket

    if tied:
        _end_with_stdin()
    path = Path(service) if service is not None and "/" in service else find_control_socket(service)
    return serve(path, port, token_file, lambda address: click.echo(f"panel: {address}", err=True), opens, foxglove)


def _end_with_stdin() -> None:
    """As by SIGTERM, once whoever holds the other end has gone."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


COMMANDS = (panel,)

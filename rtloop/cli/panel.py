"""The command of the panel: a running loop in the browser."""

from __future__ import annotations

from pathlib import Path

import click

from rtloop.cli.options import OUTPUT, fails_clearly

PORT = 8321


@click.command()
@click.argument("service", metavar="[NAME|SOCKET]", required=False)
@click.option("--port", default=PORT, show_default=True, type=click.IntRange(0, 65535), help="0 is any free one.")
@click.option("--open", "opens", is_flag=True, help="Open it in the browser.")
@click.option("--token-file", type=OUTPUT, help="Holds the token, and is made where it is not there.")
@click.option("--foxglove", is_flag=True, help="Serve viewers of the Foxglove WebSocket protocol; they can only look.")
@fails_clearly
def panel(service: str | None, port: int, opens: bool, token_file: Path | None, foxglove: bool) -> int:
    """Show a running loop in the browser: a scope, a spectrum, a desk.

    NAME is that of a service, SOCKET the path of its control socket; the only service that runs is taken without
    either. The panel is a process of its own, and whatever becomes of it, no tick waits. It listens on 127.0.0.1 alone.
    """
    from rtloop.panel.web.server import serve
    from rtloop.service.client.finding import socket_of

    path = Path(service) if service is not None and "/" in service else socket_of(service)
    return serve(path, port, token_file, lambda address: click.echo(f"panel: {address}", err=True), opens, foxglove)


COMMANDS = (panel,)

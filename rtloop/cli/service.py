"""The daemon: serve a loop, park after it, and be the board that it drives."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click

from rtloop.cli.options import CONFIG, fails_clearly
from rtloop.cli.panel import beside, with_panel


class ServiceName(click.ParamType):
    """A plain file name: socket and shared block of a service are files of its name."""

    name = "text"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """The name; a usage error where it is none."""
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", value):
            self.fail(f"{value!r}: letters, digits, '.', '_' and '-' are allowed, at most 64", param, ctx)
        return value


@click.command()
@CONFIG
@click.option("--name", type=ServiceName(), help="Name of the service, for `ctl --name` [that of CONFIG's file].")
@with_panel
@fails_clearly
def serve(config: Path, name: str | None, panel: bool, panel_port: int) -> int:
    """Run the loop of CONFIG as a daemon with a control API.

    It tells systemd how it is, and ends when it is told to.
    """
    from rtloop.service.daemon import serve as serve_configuration

    with beside(config, panel, panel_port, name):
        return serve_configuration(config, name=name)


@click.command()
@CONFIG
@fails_clearly
def park(config: Path) -> int:
    """Ramp every output of CONFIG to its safe value."""
    from rtloop.supervision.parking import park_configuration

    click.echo(park_configuration(config), err=True)
    return 0


@click.group()
def hil() -> None:
    """The simulated rig as a process of its own."""


@hil.command("serve")
@CONFIG
@click.option("--can", "on_can", is_flag=True, help="Be a node on the CAN bus of CONFIG, whose driver is of kind can.")
@fails_clearly
def hil_serve(config: Path, on_can: bool) -> int:
    """Be the board of CONFIG, whose driver is of kind shm.

    A rig with a clock of its own, which outlives its controllers.
    """
    from rtloop.commands.board import serve_board, serve_node

    return serve_node(config) if on_can else serve_board(config)


COMMANDS = (serve, park, hil)

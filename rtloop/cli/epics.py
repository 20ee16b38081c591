"""`rtloop epics`: a running loop as EPICS channels."""

from __future__ import annotations

import ipaddress
from pathlib import Path

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import OUTPUT, MatchingText
from rtloop.errors import MissingExtra

PREFIX = MatchingText("prefix", r"[A-Za-z0-9_:;<>\[\]-]{1,40}", "1 to 40 letters, digits and _ - : ; < > [ ]")


class Address(click.ParamType):
    """An IPv4 address."""

    name = "address"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the IPv4 address, such as "192.168.1.2". Fails with a usage error for any other text."""
        try:
            return str(ipaddress.IPv4Address(value))
        except ValueError:
            self.fail(
                f"value is {value!r}; allowed: an IPv4 address of this host, or 0.0.0.0 for all addresses", param, ctx
            )


@click.command()
@click.option("--name", help="Name of the service, such as NAME for NAME.toml.  [default: the only running service]")
@click.option("--socket", "socket_path", type=OUTPUT, help="Path of the service's control socket, instead of --name.")
@click.option(
    "--prefix",
    type=PREFIX,
    help="Beginning of the name of each channel, such as LAB:LOOP:.  [default: NAME: with the service's name]",
)
@click.option(
    "--interface",
    type=Address(),
    default="127.0.0.1",
    show_default=True,
    help="IPv4 address of this host at which clients are served; 0.0.0.0: all addresses.",
)
@click.option("--allow-control", is_flag=True, help="Let every client that reaches --interface drive the loop.")
@click.option("--as", "as_name", metavar="NAME", default="epics", show_default=True,
              help="Name under which the clients' commands are recorded and hold the lock.")  # fmt: skip
@report_errors
def epics(
    name: str | None, socket_path: Path | None, prefix: str | None, interface: str, allow_control: bool, as_name: str
) -> int:
    """Serve a running loop as EPICS channels (Channel Access).

    The server is a separate process; no tick waits for it. Clients can only read, unless --allow-control is used. The
    port is EPICS_CA_SERVER_PORT, by default 5064.
    """
    from rtloop.client.control_socket import find_control_socket

    try:
        from rtloop.epics.server import serve
    except ModuleNotFoundError as error:
        if error.name != "caproto":
            raise
        raise MissingExtra("rtloop epics needs caproto: pip install 'rtloop[epics]'") from None
    path = socket_path or find_control_socket(name)
    log = lambda text: click.echo(f"epics: {text}", err=True)
    return serve(path, prefix or f"{path.stem}:", interface, allow_control, as_name, log)

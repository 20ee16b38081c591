"""`rtloop demo`: a loop with its panel, on a simulated board, without any file."""

from __future__ import annotations

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.panel import port_option


@click.command()
@port_option("--port")
@report_errors
def demo(port: int) -> int:
    """Show a loop on a simulated board in the browser.

    Needs no file and no hardware. Open the address that is printed, arm the outputs and start the loop. Ctrl-C parks
    the outputs and ends all processes; the recordings are removed.
    """
    from rtloop.starters.demonstration import demonstrate

    return demonstrate(port, lambda line: click.echo(line, err=True))

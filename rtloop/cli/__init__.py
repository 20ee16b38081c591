"""The command line. Nothing below this package sees the whole of a configuration and the terminal at once."""

from __future__ import annotations

import os

import click

from rtloop.cli import (
    adapt,
    ctl,
    design,
    doctor,
    experiment,
    identify,
    interchange,
    laws,
    loop,
    panel,
    recordings,
    response,
    service,
)
from rtloop.version import __version__

# matrices here have tens of rows: a library's threads wait for each other longer than they compute, on the loop's cores
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="rtloop")
def main() -> None:
    """Close a hard, fast control loop from Python, record every tick, and believe what it did.

    \b
    Start here:
      rtloop check deploy/paper.toml              what would run, its margins, its limits
      rtloop run deploy/paper.toml --duration 10  run it on the simulated rig, and record it
      rtloop info recordings/FILE.mcap            what a recording holds

    Exit codes: 0 good; 1 fault, trip, loss or difference; 2 usage; 66 input file; 69 hardware or service not
    available; 73 cannot write; 77 refused by the host; 78 configuration.
    """


for module in (
    loop,
    laws,
    doctor,
    recordings,
    interchange,
    service,
    ctl,
    panel,
    identify,
    response,
    adapt,
    ctl,
    design,
    experiment,
):
    for command in module.COMMANDS:
        main.add_command(command)

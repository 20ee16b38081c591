"""`rtloop replay`: a recording executed again, with the recorded law or with another configuration's law or rig."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import FILES, JSON, OUTPUT
from rtloop.cli.output import echo_json
from rtloop.cli.output.progress import Counter
from rtloop.workbench.tables import console


@click.command()
@FILES
@click.option("--config", type=OUTPUT, help="Run the law of this configuration on the recorded inputs.")
@click.option("--resimulate", is_flag=True, help="Run the recorded reference in closed loop with the simulated rig.")
@click.option(
    "--law",
    "laws",
    type=OUTPUT,
    multiple=True,
    help="Python file of a recorded law that is not installed on this host; repeatable.",
)
@click.option(
    "--trust-recorded-law",
    is_flag=True,
    help="Run the code of the laws in the recording; use it only if you trust the recording.",
)
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    help="Number of processes that replay at the same time.  [default: one for each processor]",
)
@JSON
@report_errors
def replay(
    files: tuple[Path, ...],
    config: Path | None,
    resimulate: bool,
    laws: tuple[Path, ...],
    trust_recorded_law: bool,
    jobs: int | None,
    as_json: bool,
) -> int:
    """Execute a recording again and compare its outputs.

    Compares every output of every tick, byte by byte; exit 1 where one differs.

    With --config: computes the commands of another law on the same inputs, from rest. With --resimulate: runs the
    recorded reference in closed loop on a simulated rig; law and rig are those of --config, or the recorded ones
    without it. Both run in one process, since each tick follows from the one before, and end with exit code 0.
    """
    from rtloop.workbench.replay import ReplayResult
    from rtloop.workbench.replay import replay as execute_again

    with Counter("ticks replayed", sys.stderr) as counter:
        result = execute_again(
            files,
            config=config,
            resimulate=resimulate,
            law=laws,
            trust_recorded_law=trust_recorded_law,
            jobs=jobs or len(os.sched_getaffinity(0)),
            progress=counter.show,
        )
    echo_json(result.as_dict()) if as_json else result.print_text(console())
    return 1 if isinstance(result, ReplayResult) and not result.identical else 0

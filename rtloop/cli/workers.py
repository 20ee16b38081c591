"""The workers of campaigns and archives: their options on the command line, and the workers that these choose."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from rtloop.cli.output import print_warnings

if TYPE_CHECKING:
    from rtloop.campaigns.workers import Workers

WORKERS = (
    click.option(
        "--jobs", type=click.IntRange(1, 1024), help="Number of worker processes.  [default: one for each processor]"
    ),
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Address of a Dask scheduler, such as tls://HOST:8786, whose workers replace the local processes; without "
        "TLS, who reaches it can run any program.",
    ),
)


def worker_options(command: Callable[..., object]) -> Callable[..., object]:
    """Add the options --jobs and --scheduler to a command. Returns the command."""
    for option in reversed(WORKERS):
        command = option(command)
    return command


@contextmanager
def choose_workers(
    jobs: int | None, scheduler: str | None, preload: str = "rtloop.campaigns.unit"
) -> Iterator[Workers]:
    """Yield the workers that run a command's functions, and close them at the end of the block.

    The workers are `jobs` processes of this host (None: one for each processor), each of which has imported the module
    `preload`; or, if `scheduler` is given, the workers of the Dask scheduler at this address. Raises UsageError if both
    are given, and the errors of `DaskWorkers`. Prints a warning for a scheduler that is open to other hosts.
    """
    if jobs and scheduler:
        raise click.UsageError(
            "--jobs: not allowed with --scheduler, which sets the number of workers; leave --jobs out"
        )
    from rtloop.campaigns.workers import DaskWorkers, ProcessWorkers

    workers = DaskWorkers(scheduler) if scheduler else ProcessWorkers(jobs, preload=preload)
    if isinstance(workers, DaskWorkers):
        print_warnings(workers.warnings())
    try:
        yield workers
    finally:
        workers.close()

"""The workers of campaigns and archives: their options on the command line, and the workers that these choose."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rtloop.campaigns.workers import Workers

WORKERS = (
    click.option(
        "--jobs", type=click.IntRange(1, 1024), help="Number of worker processes.  [default: one for each processor]"
    ),
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Address of a Dask scheduler, such as tcp://HOST:8786, whose workers replace the local processes.",
    ),
)


def worker_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of WORKERS to a command. Returns the command."""
    for option in reversed(WORKERS):
        command = option(command)
    return command


@contextmanager
def choose_workers(
    jobs: int | None, scheduler: str | None, preload: str = "rtloop.campaigns.unit"
) -> Iterator[Workers]:
    """Start `jobs` worker processes for a block, None: one for each processor, or use the workers of a Dask scheduler.

    The block receives the workers, which are closed at its end; local processes import the module `preload` once.
    Raises UsageError for both `jobs` and `scheduler`, and errors as `DaskWorkers`.
    """
    if jobs and scheduler:
        raise click.UsageError(
            "--jobs: not allowed with --scheduler, which sets the number of workers; leave --jobs out"
        )
    from rtloop.campaigns.workers import DaskWorkers, ProcessWorkers

    workers = DaskWorkers(scheduler) if scheduler else ProcessWorkers(jobs, preload=preload)
    try:
        yield workers
    finally:
        workers.close()

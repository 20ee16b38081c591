"""`rtloop campaign search` and `boundary`: the worst rig, and the range of a key in which rigs pass."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.campaign import CAMPAIGN, CONFIGURATION, FOLDER, value_text
from rtloop.cli.exit_codes import report_errors, require_readable
from rtloop.cli.options import JSON
from rtloop.cli.output import echo_json
from rtloop.cli.output.progress import StatusLine
from rtloop.cli.workers import choose_workers, worker_options
from rtloop.workbench.tables import console, escape, table

if TYPE_CHECKING:
    from rtloop.campaigns.search import Boundary, SearchResult


@click.command()
@CAMPAIGN
@CONFIGURATION
@FOLDER
@worker_options
@click.option(
    "--rigs", default=1000, show_default=True, type=click.IntRange(1, 10_000_000), help="Number of rigs that are tried."
)
@click.option(
    "--figure",
    default="",
    help="Figure that the search maximises.  [default: the largest ratio of a figure to its limit]",
)
@click.option(
    "--target",
    type=float,
    default=float("inf"),
    help="End the search once the figure reaches this value.  [default: no target]",
)
@click.option("--record", is_flag=True, help="Record the worst rig in FOLDER/worst.")
@JSON
@report_errors
def search(
    campaign: Path, config: Path | None, out: Path | None, jobs: int | None, scheduler: str | None, rigs: int,
    figure: str, target: float, record: bool, as_json: bool,
) -> None:  # fmt: skip
    """Search for the worst rig within the ranges of the uncertain keys.

    Differential evolution begins with rigs all over the ranges and increases the figure. The search ignores how likely
    a rig is: for the share of rigs that pass, use `rtloop campaign run`.
    """
    require_readable(campaign)
    from rtloop.campaigns.campaign_file import load_campaign
    from rtloop.campaigns.case import CaseRunner
    from rtloop.campaigns.recorded_case import record_values
    from rtloop.campaigns.run import default_folder
    from rtloop.campaigns.samples import stream_word
    from rtloop.campaigns.search import evaluate_on, find_worst

    loaded = load_campaign(campaign, None, config)
    runner = CaseRunner(loaded)
    with choose_workers(jobs, scheduler) as workers, StatusLine("searching for the worst rig", sys.stderr):
        result = find_worst(runner, evaluate_on(workers, loaded), rigs, figure, target)
    folder = (out or default_folder(loaded)) / "worst"
    recordings = (
        record_values(runner, result.worst.values, f"searched-{stream_word(result.worst.values):016x}", folder)
        if record
        else []
    )
    if as_json:
        echo_json({**result._asdict(), "recordings": recordings})
    else:
        _print_worst(result, figure)
        for path in recordings:
            click.echo(path)


@click.command()
@CAMPAIGN
@click.argument("key")
@CONFIGURATION
@worker_options
@click.option(
    "--tolerance",
    default=0.0,
    type=click.FloatRange(0.0),
    help="Accuracy of the ends of the range, in the unit of KEY; 0: as fine as the search can.",
)
@JSON
@report_errors
def boundary(
    campaign: Path, key: str, config: Path | None, jobs: int | None, scheduler: str | None, tolerance: float,
    as_json: bool,
) -> None:  # fmt: skip
    """Find the range of an uncertain KEY in which the rig passes.

    The search steps from the nominal value outwards, then bisects. All other keys keep their nominal values. A failure
    between two steps may be missed.
    """
    require_readable(campaign)
    from rtloop.campaigns.campaign_file import load_campaign
    from rtloop.campaigns.case import CaseRunner
    from rtloop.campaigns.search import evaluate_on, find_boundary

    loaded = load_campaign(campaign, None, config)
    with choose_workers(jobs, scheduler) as workers, StatusLine(f"searching the range of {key}", sys.stderr):
        result = find_boundary(CaseRunner(loaded), key, evaluate_on(workers, loaded), tolerance)
    if as_json:
        echo_json(result)
    else:
        _print_boundary(result)


def _print_worst(result: SearchResult, figure: str) -> None:
    """Print values, figures and missed limits of the worst rig.

    `figure` is the name of the figure that was maximised; "" is the largest ratio of a figure to its limit.
    """
    case, out = result.worst, console()
    rows = [(escape(name), value_text(value)) for name, value in {**case.values, **case.figures}.items()]
    out.print(f"worst of {result.rigs} rigs: {escape(figure or 'figure / limit')} {result.figure:.4g}")
    out.print(table("", "", rows=rows))
    out.print(f"missed: {escape('; '.join(case.missed) or 'nothing')}")


def _print_boundary(result: Boundary) -> None:
    """Print both ends of the range in which rigs pass, the limits missed beyond them, and the number of rigs tried."""
    ends = [
        "no failure down to the end of the range" if result.low is None else f"{result.low:.6g} ({result.low_cause})",
        "no failure up to the end of the range" if result.high is None else f"{result.high:.6g} ({result.high_cause})",
    ]
    console().print(f"{escape(result.key)}: {escape(' … '.join(ends))}; tried: {result.rigs} rigs")

"""`rtloop campaign compare`: two configurations on the same rigs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.campaign import PAGE, write_page
from rtloop.cli.exit_codes import report_errors, require_readable
from rtloop.cli.options import JSON, OUTPUT
from rtloop.cli.output import echo_json
from rtloop.workbench.tables import console, escape, table
from rtloop.workbench.written_files import path_from

if TYPE_CHECKING:
    from rtloop.campaigns.comparison import Comparison


@click.command()
@click.argument("first", type=OUTPUT)
@click.argument("second", type=OUTPUT)
@PAGE
@JSON
@report_errors
def compare(first: Path, second: Path, page: Path | None, as_json: bool) -> None:
    """Compare the results in two folders, rig by rig.

    FIRST and SECOND must have the same rigs: run `rtloop campaign run CAMPAIGN` once without and once with --config.
    Yields are compared by McNemar's test, figures by the median of their differences, with an interval of 95 %.
    """
    for folder in (first, second):
        if folder.is_file():
            require_readable(folder)
    from rtloop.campaigns.comparison import compare_campaigns

    comparison = compare_campaigns(first, second)
    if as_json:
        echo_json(comparison)
    else:
        _print_comparison(comparison)
    if page is not None:
        from rtloop.campaigns.page import render_comparison
        from rtloop.campaigns.summary import summarise_campaign

        folders = (first, second)
        summaries = [summarise_campaign(folder) for folder in folders]
        write_page(page, render_comparison(folders, summaries, comparison, partial(path_from, page)))


def _print_comparison(comparison: Comparison) -> None:
    """Print both yields, the numbers of rigs that only one configuration passes, and the differences of the figures."""
    out, (first, second) = console(), map(escape, comparison.names)
    for name, estimate in zip((first, second), comparison.yields, strict=True):
        out.print(
            f"{name}: {estimate.passed:,} of {estimate.rigs:,} rigs pass, {100 * estimate.share:.2f} % "
            f"(95 % interval {100 * estimate.low:.2f} … {100 * estimate.high:.2f} %)"
        )
    out.print(
        f"rigs that pass only with {first}: {comparison.only_first:,}; only with {second}: {comparison.only_second:,}. "
        f"If both were equally good, the probability of such a difference would be p = {comparison.p_value:.3g}"
    )
    rows = [
        (
            escape(name),
            f"{difference.median:+.4g}",
            f"{difference.low:+.4g}",
            f"{difference.high:+.4g}",
            f"{difference.rigs:,}",
        )
        for name, difference in comparison.figures.items()
    ]
    out.print(table(f"median of {second} − {first}", "", "from", "to", "rigs", rows=rows))

"""`rtloop campaign`: one configuration on thousands of simulated rigs, and a report of how many keep its promise."""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rtloop.cli.exit_codes import report_errors, require_readable
from rtloop.cli.options import JSON, OUTPUT, TARGET
from rtloop.cli.output import echo_json
from rtloop.cli.output.progress import StatusLine
from rtloop.cli.workers import choose_workers, worker_options
from rtloop.errors import LoopFault
from rtloop.values import count_text
from rtloop.workbench.tables import console, escape, table
from rtloop.workbench.written_files import path_from, write_output

if TYPE_CHECKING:
    from rtloop.campaigns.coordinator import Progress
    from rtloop.campaigns.summary import CampaignSummary

CAMPAIGN = click.argument("campaign", type=OUTPUT)
FOLDER = click.option("--out", type=TARGET, help="Folder of the results.  [default: campaigns/CAMPAIGN-CONFIG]")
CONFIGURATION = click.option(
    "--config", type=OUTPUT, help="Configuration that replaces the one in CAMPAIGN, to compare both on the same rigs."
)
RIGS = click.option(
    "--rigs", type=click.IntRange(1, 10_000_000), help="Number of sampled rigs.  [default: the number in CAMPAIGN]"
)
PAGE = click.option("--page", type=TARGET, help="Write the report to this file, too, as one HTML page.")
STOPPED = 130
"""Exit code of a campaign that Ctrl-C has stopped."""


@click.group()
def campaign() -> None:
    """Run thousands of simulated rigs that differ.

    CAMPAIGN.toml names a configuration, the distribution of every key that is uncertain, and the experiments of each
    rig; deploy/campaign.toml is a complete example.
    """


@campaign.command()
@CAMPAIGN
@CONFIGURATION
@FOLDER
@RIGS
@worker_options
@PAGE
@JSON
@report_errors
def run(
    campaign: Path,
    config: Path | None,
    out: Path | None,
    rigs: int | None,
    jobs: int | None,
    scheduler: str | None,
    page: Path | None,
    as_json: bool,
) -> int:
    """Run a campaign and report its yield.

    The same command continues a campaign that was interrupted, and adds rigs where --rigs is larger than before. After
    Ctrl-C, the rigs that run are finished, and no other begins. Results are Parquet files in the folder of --out, with
    recordings of the worst rigs.

    Exit 0 where every rig that can run passed. Exit 1 where a rig exceeded a limit, tripped or crashed its worker, or
    where no rig can run.
    """
    require_readable(campaign)
    from rtloop.supervision.interruption import Interruption

    with Interruption() as interruption:
        from rtloop.campaigns.campaign_file import load_campaign
        from rtloop.campaigns.run import default_folder, run_campaign
        from rtloop.campaigns.store import arrow

        arrow()  # before anything is said of a campaign that cannot run
        loaded = load_campaign(campaign, rigs, config)
        folder = out or default_folder(loaded)
        with choose_workers(jobs, scheduler) as workers, CampaignView("starting", sys.stderr) as view:
            count = count_text(loaded.options.rigs, "rig")
            click.echo(f"{loaded.name}: {count} on {workers.name}; {folder}", err=True)
            is_complete = run_campaign(loaded, folder, workers, view.show, lambda: interruption.requested)
    if not is_complete:
        click.echo(f"stopped; the results so far are in {folder}. To continue, run the same command again", err=True)
        return STOPPED
    return _report(folder, loaded.options.keep_worst, as_json, page)


@campaign.command()
@click.argument("folder", type=OUTPUT)
@click.option(
    "--worst",
    "worst_count",
    default=5,
    show_default=True,
    type=click.IntRange(0, 1000),
    help="Number of worst rigs shown.",
)
@PAGE
@JSON
@report_errors
def report(folder: Path, worst_count: int, page: Path | None, as_json: bool) -> int:
    """Report from the results in FOLDER alone.

    Exit 0 where every rig that can run passed. Exit 1 where a rig exceeded a limit, tripped or crashed its worker, or
    where no rig can run.
    """
    if folder.is_file():
        require_readable(folder)
    return _report(folder, worst_count, as_json, page)


@campaign.command()
@CAMPAIGN
@click.argument("rig", type=click.IntRange(0))
@CONFIGURATION
@FOLDER
@RIGS
@click.option("--record", is_flag=True, help="Record each experiment of the rig in FOLDER/worst.")
@JSON
@report_errors
def rerun(
    campaign: Path, rig: int, config: Path | None, out: Path | None, rigs: int | None, record: bool, as_json: bool
) -> int:
    """Repeat one rig here, and compare it with its stored result.

    RIG is the number of the rig: 0 is the nominal rig, 1 and above are the sampled ones. Exit 1 if the results differ.
    """
    require_readable(campaign)
    from rtloop.campaigns.campaign_file import load_campaign
    from rtloop.campaigns.case import CaseRunner
    from rtloop.campaigns.recorded_case import record_rig
    from rtloop.campaigns.run import default_folder
    from rtloop.campaigns.store import open_store

    loaded = load_campaign(campaign, rigs, config)
    runner, folder = CaseRunner(loaded), out or default_folder(loaded)
    if rig > loaded.options.rigs:
        raise click.UsageError(f"RIG: value is {rig}; allowed: 0 … {loaded.options.rigs}. For more rigs, use --rigs")
    case = runner.run(rig)
    with open_store(folder, loaded, runner.sample_values(0)) as store:
        is_equal = store.equals(case)
    recordings = record_rig(runner, rig, folder / "worst") if record else []
    verdict = {
        True: "equal to the stored result",
        False: "DIFFERS from the stored result",
        None: "has no stored result",
    }
    if as_json:
        echo_json({"case": case, "equal": is_equal, "recordings": recordings})
    else:
        rows = [(key, f"{value:g}" if isinstance(value, float) else str(value)) for key, value in case.values.items()]
        rows += [(name, f"{value:.6g}") for name, value in case.figures.items()]
        console().print(table("", "", rows=rows))
        console().print(f"rig {rig}: {escape(case.refusal or '; '.join(case.missed) or 'passed')}; {verdict[is_equal]}")
        for path in recordings:
            click.echo(path)
    return LoopFault.exit_code if is_equal is False else 0


class CampaignView(StatusLine):
    """A status line with the rigs that have results, their rate and the time left."""

    _begin: tuple[float, int] | None = None

    def show(self, progress: Progress) -> None:
        """Show number of rigs with results, rate and time left; the rate counts from the first call on."""
        now_s = time.monotonic()
        begin_s, begin_done = self._begin = self._begin or (now_s, progress.done)
        text = f"{progress.done:,} of {progress.total:,} rigs"
        if progress.done > begin_done:
            rate_per_s = (progress.done - begin_done) / max(now_s - begin_s, 1e-3)
            text += f"   {rate_per_s:.0f} rigs/s   {(progress.total - progress.done) / rate_per_s:.0f} s left"
        self.update(text if progress.done < progress.total else f"{text}   recording the worst rigs")


def write_page(page: Path, html: str) -> None:
    """Write an HTML page, over an existing file, and print its path on stderr. Raises OutputError if the system
    refuses.
    """
    write_output(page, html.encode("utf-8", "replace"))
    click.echo(page, err=True)


def _report(folder: Path, worst_count: int, as_json: bool, page: Path | None) -> int:
    """Print the summary of a campaign's results in `folder`, with its `worst_count` worst rigs; then write it as HTML
    to `page`, if given, over an existing file.

    Returns the exit code: 0 if every rig that can run passed, 1 if one did not or none can run. Raises InputFileError
    for a folder without results or with damaged ones, MissingExtra without pyarrow, OutputError if `page` cannot be
    written.
    """
    from rtloop.campaigns.summary import summarise_campaign

    summary = summarise_campaign(folder, worst_count)
    if as_json:
        echo_json(summary)
    else:
        _print_summary(summary, folder)
    if page is not None:
        from rtloop.campaigns.page import render_campaign

        click.echo(f"drawing the pictures of {page}, for up to a minute", err=True)
        write_page(page, render_campaign(folder, summary, partial(path_from, page)))
    has_failed = summary.counts["failed"] + summary.counts["crashed"] > 0 or not summary.counts["passed"]
    return LoopFault.exit_code if has_failed else 0


def _print_summary(summary: CampaignSummary, folder: Path) -> None:
    """Print yield, figures, causes of failures, variances, worst rigs with the folder of their recordings, and rigs
    that crashed or cannot run.
    """
    from rtloop.campaigns.recorded_case import has_ticks

    out, estimate = console(), summary.yield_of_rigs
    out.print(
        f"{escape(summary.name)}: {estimate.passed:,} of {count_text(estimate.rigs, 'rig')} pass, yield "
        f"{100 * estimate.share:.2f} % (95 % interval {100 * estimate.low:.2f} … {100 * estimate.high:.2f} %)"
    )
    has_limits = any(figure.limit is not None for figure in summary.figures.values())
    if summary.figures and not has_limits:
        out.print("the campaign has no limits: a rig fails by a trip alone")
    rows = [
        (escape(name), *(f"{value:.4g}" for value in figure.quantiles), f"{figure.largest:.4g}",
         *(("–", "–") if figure.limit is None else (f"{figure.limit:g}", str(figure.exceeding))))
        for name, figure in summary.figures.items()
    ]  # fmt: skip
    out.print(table("figure", "5 %", "median", "95 %", "worst", "limit", "rigs beyond", rows=rows))
    for cause, count in sorted(summary.causes.items(), key=lambda item: -item[1]):
        out.print(f"  {count_text(count, 'rig')}: {escape(cause)}")
    for name, indices in summary.sensitivity.items():
        rows = [
            (escape(key), *(f"{value:.3f}" for value in index))
            for key, index in indices.items()
            if index.total == index.total
        ]
        if rows:
            out.print(table(f"variance of {name}", "alone", "from", "to", "with others", "from", "to", rows=rows))
    if summary.worst_rigs and has_limits:
        keys = list(summary.worst_rigs[0].values)
        rows = [
            (str(rig.rig), f"{rig.ratio:.3g}", *(value_text(rig.values[key]) for key in keys))
            for rig in summary.worst_rigs
        ]
        out.print(table("worst rig", "figure / limit", *(key.rpartition(".")[2] for key in keys), rows=rows))
        recordings = sorted((folder / "worst").glob("*.mcap"))
        empty = [path.name for path in recordings if not has_ticks(path)]
        if len(recordings) > len(empty):
            out.print(f"recordings: {escape(folder / 'worst')}")
        for name in empty:
            out.print(f"[red]{escape(name)}[/] has no tick; `rtloop campaign run` records it again")
    for rig in summary.crashed:
        out.print(f"[red]rig {rig}[/]: the worker process died each time that this rig ran; the rig counts as failed")
    for rig, text in summary.refused[:5]:
        out.print(f"[yellow]rig {rig}[/] cannot run and is not counted: {escape(text)}")
    if len(summary.refused) > 5:
        out.print(f"[yellow]and {len(summary.refused) - 5} more rigs that cannot run[/]")


def value_text(value: object) -> str:
    """Return a configuration's value as text for rich: a float with four significant digits, brackets escaped."""
    return f"{value:.4g}" if isinstance(value, float) else escape(value)

"""`rtloop info`: summary of a recording."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from rtloop.cli.exit_codes import report_errors
from rtloop.cli.options import FILES, JSON
from rtloop.cli.output import echo_json
from rtloop.cli.output.progress import Counter
from rtloop.workbench.summary_text import print_summary
from rtloop.workbench.tables import console


@click.command()
@FILES
@JSON
@report_errors
def info(files: tuple[Path, ...], as_json: bool) -> None:
    """Summarise a recording.

    Prints completeness, timing, errors, drives and steps. The files of a rotated run count as one recording.
    """
    from rtloop.recording.load import load
    from rtloop.recording.views.summary import summarise
    from rtloop.workbench.run_text import print_steps
    from rtloop.workbench.step_figures import steps_of_run

    with Counter("ticks read", sys.stderr) as counter:
        summary = summarise(files, counter.show)
    if as_json:
        echo_json(summary.as_dict())
        return
    print_summary(console(), summary)
    if steps := steps_of_run(summary, load(files)):
        print_steps(console(), steps)

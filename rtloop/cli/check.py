"""`rtloop check`: a configuration's loop, its limits and its margins on paper."""

from __future__ import annotations

from pathlib import Path

import click

from rtloop.cli.exit_codes import report_errors, require_readable
from rtloop.cli.options import CONFIG, JSON
from rtloop.cli.output import echo_json, print_warnings
from rtloop.workbench.tables import console


@click.command()
@CONFIG
@click.option("--strict", is_flag=True, help="Treat warnings as faults.")
@JSON
@report_errors
def check(config: Path, strict: bool, as_json: bool) -> int:
    """Show and judge the loop of CONFIG; touches no hardware.

    Shows limits, C(z) against C(s), margins on the model, and the verdict by the axis's specification. Exit 1 where
    the hardware of CONFIG contradicts the judged loop, or the loop does not follow its reference.
    """
    require_readable(config)
    from rtloop.workbench.check import check as judge

    result = judge(config, strict=strict)
    if as_json:
        echo_json(result.as_dict())
    else:
        result.print_text(console())
        print_warnings(result.warnings)
    return int(any(judgement.problems for judgement in result.axes.values()))

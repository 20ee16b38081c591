"""`rtloop run`: the supervisor with a terminal in front of it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from rtloop.configuration.cautions import option_cautions
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.errors import LoopFault, RtloopError
from rtloop.foundation.native.cache import CACHE_FOLDER, CACHE_IS_PERSISTENT
from rtloop.foundation.trusted import open_own
from rtloop.recording.file.recover import find_leftovers, recover
from rtloop.recording.views.summary import Summary, summarise
from rtloop.supervision.interruption import Interruption
from rtloop.supervision.recording_path import new_recording_path
from rtloop.supervision.supervisor import Processes, RunResult, Supervisor
from rtloop.terminal.machine import echo_json
from rtloop.terminal.progress import Counter
from rtloop.terminal.run import RunView, print_run
from rtloop.values import count_text


def run_configuration(
    config: Path, duration_s: float | None, paced: bool, out: Path | None, as_json: bool, interruption: Interruption
) -> int:
    """Run, record, report; returns the exit code."""
    with Processes() as processes:
        prepared = prepare(load(config), duration_s=duration_s, paced=paced)
        warnings = [*prepared.warnings, *option_cautions(prepared)]
        for warning in (*warnings, *_cache_warnings()):
            click.echo(f"warning: {warning}", err=True)
        path = new_recording_path(prepared, out)
        recover_leftovers(path.parent)
        if interruption.requested:
            return _stopped_before(as_json)
        supervisor = Supervisor(processes, prepared, path)
        interruption.set_supervisor(supervisor)
        with RunView(prepared, sys.stderr) as view:
            result = supervisor.run(view.show)
        interruption.set_supervisor(None)
    summary = summarise(result.recordings) if result.recordings else None
    if as_json:
        echo_json(_for_json(summary, result, warnings, supervisor.startup_s))
    else:
        print_run(prepared, summary)
    for note in result.notes:
        click.echo(f"note: {note}", err=True)
    if result.error:
        click.echo(f"rtloop: {result.error}", err=True)
    return result.exit_code or (LoopFault.exit_code if summary and summary.trips else 0)


def _stopped_before(as_json: bool) -> int:
    """Ctrl-C came before there was a loop: no output was touched, and that is what was wanted."""
    click.echo("stopped before the loop began: nothing was driven, nothing is recorded", err=True)
    if as_json:
        echo_json({"outcome": "stopped", "recording": None, "recordings": []})
    return 0


def _cache_warnings() -> list[str]:
    """What to say where compiled code cannot be kept."""
    if CACHE_IS_PERSISTENT:
        return []
    return [f"no cache folder can be written: compiled code is in {CACHE_FOLDER}, and is made anew when that is gone"]


def _for_json(
    summary: Summary | None, result: RunResult, warnings: list[str], startup_s: float | None
) -> dict[str, Any]:
    """The recording's summary, if there is one, with what the run adds to it."""
    return {"trips": [], **(summary.as_dict() if summary else {"recording": None})} | {
        "recordings": [str(path) for path in result.recordings],
        "notes": list(result.notes),
        "outcome": result.outcome,
        "error": result.error,
        "recorder": result.recorder,
        "warnings": warnings,
        "startup_s": startup_s,
    }


def recover_leftovers(folder: Path) -> None:
    """Complete what killed runs left in `folder`, and say so; what cannot be is said too and stays."""
    for part in find_leftovers(folder):
        try:
            with Counter("ticks recovered", sys.stderr) as counter:
                report = recover(part, progress=counter.show, opener=open_own)
        except RtloopError as error:
            click.echo(f"warning: {error}", err=True)
            continue
        click.echo(
            f"{report['output']}: {count_text(report['ticks'], 'tick')} recovered from {part.name}, which is kept",
            err=True,
        )
        for problem in report["problems"]:
            click.echo(f"warning: {part}: {problem}", err=True)

"""The command line. Nothing below this module sees the whole of a configuration and the terminal at once."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from rtloop import __version__


def _fails_clearly(command: Callable[..., int | None]) -> Callable[..., None]:
    """Turn the project's errors into one message and the right exit code; never a traceback for a user's mistake."""

    @wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> None:
        from drivers.errors import DriverError
        from rtloop.errors import RtloopError, UnavailableError
        from rtloop.recording.errors import RecordingError

        try:
            code = command(*args, **kwargs) or 0
        except (RtloopError, RecordingError, DriverError) as error:
            code = UnavailableError.exit_code if isinstance(error, DriverError) else error.exit_code
            click.echo(f"rtloop: {error}", err=True)
            if kwargs.get("as_json"):
                click.echo(json.dumps({"error": str(error), "exit_code": code}))
        sys.exit(code)

    return wrapped


class _Seconds(click.ParamType):
    name = "seconds"

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if not 0 < seconds < math.inf:
            self.fail(f"{value}: a number of seconds above 0 is needed", param, ctx)
        return seconds


CONFIG = click.argument("config", type=click.Path(path_type=Path))
FILE = click.argument("file", type=click.Path(path_type=Path))
JSON = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, everything else on stderr.")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="rtloop")
def main() -> None:
    """Close a hard, fast control loop from Python, record every tick, and believe what it did.

    \b
    Start here:
      rtloop check deploy/paper.toml              what would run, its margins, its limits
      rtloop run deploy/paper.toml --duration 10  run it on the simulated rig, and record it
      rtloop info recordings/FILE.mcap            what a recording holds

    Exit codes: 0 good; 1 fault, trip or loss; 2 usage; 66 input file; 69 hardware or service not available;
    73 cannot write; 77 refused by the host; 78 configuration.
    """


@main.command()
@CONFIG
@click.option("--duration", "duration_s", type=_Seconds(), help="Seconds to run, as a number of ticks [until Ctrl-C].")
@click.option("--unpaced", is_flag=True, help="In virtual time, as fast as the machine goes (simulated hardware only).")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for the recording [the configuration's].")
@JSON
@_fails_clearly
def run(config: Path, duration_s: float | None, unpaced: bool, out: Path | None, as_json: bool) -> int:
    """Run the loop of CONFIG and record every tick; Ctrl-C ramps down, finishes the recording and ends well."""
    from rtloop.running import run_configuration

    return run_configuration(config, duration_s, not unpaced, out, as_json)


@main.command()
@CONFIG
@JSON
@_fails_clearly
def check(config: Path, as_json: bool) -> int:
    """Validate CONFIG and show what would run: law, C(z) against C(s), margins, limits. Touches no hardware."""
    from rtloop.checking import check_configuration

    return check_configuration(config, as_json)


@main.command()
@FILE
@JSON
@_fails_clearly
def info(file: Path, as_json: bool) -> int:
    """Show what the recording FILE holds: completeness, timing, errors, drives."""
    from rtloop.recording.summary import summarise

    summary = summarise(file)
    if as_json:
        click.echo(json.dumps(summary))
    else:
        from rtloop.report import print_summary

        print_summary(summary)
    return 0


@main.command()
@FILE
@JSON
@_fails_clearly
def replay(file: Path, as_json: bool) -> int:
    """Re-execute the recording FILE and compare every output of every tick in bytes; exit 1 where one differs."""
    from rtloop.recording.load import load
    from rtloop.recording.replay import replay as replay_recording
    from rtloop.report import Counter, print_replay

    recording = load(file)
    with Counter("ticks replayed", sys.stderr) as counter:
        report = replay_recording(recording, counter.show)
    if as_json:
        click.echo(json.dumps(report.as_dict()))
    else:
        print_replay(file, report)
    return 0 if report.identical else 1


@main.command()
@_fails_clearly
def drivers() -> int:
    """List the backends and what each can do."""
    from rtloop.report import print_drivers

    print_drivers()
    return 0


if __name__ == "__main__":
    main()

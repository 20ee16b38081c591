"""`python -m tests.benchmarks [NAME …]`: run the named benchmarks, or all; print and store their figures."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.benchmarks import (
    backends,
    history,
    kernels,
    lateness,
    linear,
    memory,
    node,
    overhead,
    page,
    processes,
    rates,
    recordings,
    trend,
    writers,
)
from tests.benchmarks.measure import FULL, QUICK, Effort, MeasurementUnavailable
from tests.benchmarks.targets import Figure, figures, number

BENCHMARKS: dict[str, Callable[[Effort], dict[str, Any]]] = {
    "law": kernels.law,
    "loop": kernels.loop,
    "axes": kernels.axes,
    "overhead": overhead.overhead,
    "linear": linear.linear,
    "backends": backends.backends,
    "node": node.node,
    "writers": writers.writers,
    "lateness": lateness.lateness,
    "latency": lateness.latency,
    "rates": rates.rates,
    "recorded": processes.recorded,
    "recorder": processes.recorder,
    "replay": recordings.replay,
    "export": recordings.export,
    "start": processes.start,
    "memory": memory.memory,
}
NOT_MEASURED, FAILED = "not measured", "failed"


def main() -> int:
    """Run the benchmarks and print the figures of each as soon as it ends; return 1 if one failed, otherwise 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of {', '.join(BENCHMARKS)}; without: all")
    parser.add_argument("--quick", action="store_true", help="a few short repetitions: a check only, no valid figures")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write this run's figures to FILE too")
    parser.add_argument("--page", type=Path, metavar="FILE", help="run nothing: put the newest figures into FILE")
    options = parser.parse_args()
    unknown = [name for name in options.names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"{', '.join(unknown)}: there are {', '.join(BENCHMARKS)}")
    if options.page and (options.names or options.quick or options.json):
        parser.error("--page runs nothing: it goes without NAME, --quick and --json")
    if options.page:
        try:
            page.rewrite(options.page, history.newest(), BENCHMARKS)
        except (OSError, page.MissingMarkers) as error:
            parser.error(str(error))
        return 0
    entries = _run(options.names or list(BENCHMARKS), QUICK if options.quick else FULL)
    if options.json:
        options.json.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    return 1 if any(FAILED in entry["results"] for entry in entries) else 0


def _run(names: list[str], effort: Effort) -> list[dict[str, Any]]:
    """Run the named benchmarks, print and store their figures; return their entries of the history."""
    conditions, entries = history.measurement_conditions(), []
    for position, name in enumerate(names, start=1):
        print(f"{position} of {len(names)}: {name}", file=sys.stderr, flush=True)
        begin_s = time.monotonic()
        try:
            results = BENCHMARKS[name](effort)
        except MeasurementUnavailable as reason:
            results = {NOT_MEASURED: str(reason)}
        except (AssertionError, OSError, RuntimeError) as error:  # One failure must not discard the others' figures.
            results = {FAILED: str(error)}
        _clear_line()
        entries.append(history.entry(name, effort, results, time.monotonic() - begin_s, conditions))
        history.append(entries[-1])
        for figure in figures(name, results):
            print(f"{name:9} {_line(figure if effort == FULL else figure._replace(target=None))}", flush=True)
    if effort == FULL:
        _add_to_trend(entries)
    return entries


def _add_to_trend(entries: list[dict[str, Any]]) -> None:
    """Add the ratios of a full run to the trend, draw it, and print the ratios that are worse than in the last run."""
    before, current = trend.read(), [row for entry in entries for row in trend.ratios(entry)]
    trend.append(current)
    trend.draw(trend.read())
    for sentence in trend.setbacks(before, current):
        print(f"worse than last time: {sentence}", flush=True)


def _line(figure: Figure) -> str:
    """Return a figure's printed line: name, value, range, and verdict on its target."""
    if isinstance(figure.value, str):
        return f"{figure.name:36} {figure.value}"
    span = "" if figure.low is None or figure.high is None else f"({number(figure.low)} … {number(figure.high)})"
    return f"{figure.name:36} {number(figure.value):>10}  {span:24} {figure.verdict}".rstrip()


def _clear_line() -> None:
    """Erase the line of progress on a terminal."""
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

"""`python -m tests.benchmarks [NAME …]`: run the benchmarks named, or all, print their figures and keep them."""

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
from tests.benchmarks.measure import FULL, QUICK, Effort, NotMeasured
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
    """Print each benchmark's figures as soon as they are known; 1 where one failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of {', '.join(BENCHMARKS)}; without: all")
    parser.add_argument("--quick", action="store_true", help="a few short repetitions: whether it works, not how fast")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write this run's figures to FILE too")
    parser.add_argument("--page", type=Path, metavar="FILE", help="run nothing: put the newest figures into FILE")
    given = parser.parse_args()
    unknown = [name for name in given.names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"{', '.join(unknown)}: there are {', '.join(BENCHMARKS)}")
    if given.page and (given.names or given.quick or given.json):
        parser.error("--page runs nothing: it goes without NAME, --quick and --json")
    if given.page:
        try:
            page.rewrite(given.page, history.newest(), BENCHMARKS)
        except (OSError, page.NoPlace) as error:
            parser.error(str(error))
        return 0
    entries = _run(given.names or list(BENCHMARKS), QUICK if given.quick else FULL)
    if given.json:
        given.json.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    return 1 if any(FAILED in entry["results"] for entry in entries) else 0


def _run(names: list[str], effort: Effort) -> list[dict[str, Any]]:
    around, entries = history.surroundings(), []
    for number_, name in enumerate(names, start=1):
        print(f"{number_} of {len(names)}: {name}", file=sys.stderr, flush=True)
        begin_s = time.monotonic()
        try:
            results = BENCHMARKS[name](effort)
        except NotMeasured as reason:
            results = {NOT_MEASURED: str(reason)}
        except (AssertionError, OSError, RuntimeError) as error:  # the figures of the others must not go with it
            results = {FAILED: str(error)}
        _clear_line()
        entries.append(history.entry(name, effort, results, time.monotonic() - begin_s, around))
        history.append(entries[-1])
        for figure in figures(name, results):
            print(f"{name:9} {_line(figure if effort == FULL else figure._replace(target=None))}", flush=True)
    if effort == FULL:
        _add_to_trend(entries)
    return entries


def _add_to_trend(entries: list[dict[str, Any]]) -> None:
    """Add the ratios of a full run to the trend, draw it, and print the ratios that became worse."""
    before, now = trend.read(), [row for entry in entries for row in trend.ratios(entry)]
    trend.append(now)
    trend.draw(trend.read())
    for sentence in trend.setbacks(before, now):
        print(f"worse than last time: {sentence}", flush=True)


def _line(figure: Figure) -> str:
    if isinstance(figure.value, str):
        return f"{figure.name:36} {figure.value}"
    span = "" if figure.low is None or figure.high is None else f"({number(figure.low)} … {number(figure.high)})"
    return f"{figure.name:36} {number(figure.value):>10}  {span:24} {figure.verdict}".rstrip()


def _clear_line() -> None:
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

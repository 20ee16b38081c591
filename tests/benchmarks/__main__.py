"""`python -m tests.benchmarks [NAME …] [--json FILE]`: run the benchmarks named, or all, and print a table."""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil.compiled import cpu_identity
from tests.benchmarks import kernels, processes

BENCHMARKS = {
    "law": kernels.law,
    "loop": kernels.loop,
    "axes": kernels.axes,
    "recorded": processes.recorded,
    "recorder": processes.recorder,
    "start": processes.start,
}


def rows(results: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Name and text of every figure, a spread as its median and (smallest … largest)."""
    found: list[tuple[str, str]] = []
    for name, value in results.items():
        if isinstance(value, Mapping) and "median" in value:
            spread = f"{value['median']:9.3f}   ({value['minimum']:.3f} … {value['maximum']:.3f})"
            found.append((prefix + name, spread))
        elif isinstance(value, Mapping):
            found += rows(value, f"{prefix}{name}  ")
        else:
            found.append((prefix + name, f"{value:9.3f}"))
    return found


def main() -> None:
    """Print each benchmark's figures as soon as they are known."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description="\n".join(_descriptions()))
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of {', '.join(BENCHMARKS)}; without: all")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE too")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in BENCHMARKS]
    if unknown:
        parser.error(f"{', '.join(unknown)}: there are {', '.join(BENCHMARKS)}")
    results: dict[str, Any] = {}
    for name in arguments.names or BENCHMARKS:
        results[name] = BENCHMARKS[name]()
        for figure, text in rows(results[name]):
            print(f"{name:9} {figure:28} {text}", flush=True)
    if arguments.json:
        host = {"cpu": cpu_identity(), "cpus": os.cpu_count(), "kernel": platform.release()}
        arguments.json.write_text(json.dumps({"host": host, **results}, indent=2) + "\n")


def _descriptions() -> list[str]:
    return [f"{name}: {function.__doc__}" for name, function in BENCHMARKS.items()]


if __name__ == "__main__":
    main()

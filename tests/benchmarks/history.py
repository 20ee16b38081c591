"""The history of this machine, no part of the sources: a file with one JSON object a line for each benchmark run."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rtloop.foundation.native.cache import cpu_identity
from tests.benchmarks.configurations import ROOT
from tests.benchmarks.measure import Effort

HISTORY = ROOT / ".benchmarks" / "history.jsonl"
PACKAGES = ("rtloop", "numpy", "numba", "llvmlite", "scipy", "control", "mcap", "zstandard", "foxglove-sdk", "h5py")


def measurement_conditions() -> dict[str, Any]:
    """Return host, versions and revision of the sources, on which the figures depend."""
    return {
        "host": {
            "cpu": _cpu_model(),
            "compiler_cpu": cpu_identity().split()[0],
            "cpus": os.cpu_count(),
            "kernel": f"{platform.release()} {platform.version()}",
            "machine": platform.machine(),
        },
        "versions": {"python": sys.version.split()[0], **{name: _version(name) for name in PACKAGES}},
        "revision": _revision(),
    }


def entry(
    benchmark: str, effort: Effort, results: dict[str, Any], took_s: float, conditions: dict[str, Any]
) -> dict[str, Any]:
    """Return a benchmark's line of the history; `conditions` come from `measurement_conditions`."""
    date = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    load = os.getloadavg()[0]
    return {
        "benchmark": benchmark, "date": date, "pairs": effort.pairs, "share": effort.share, "took_s": round(took_s, 1),
        "load": round(load, 2), **conditions, "results": results,
    }  # fmt: skip


def append(line: dict[str, Any]) -> None:
    """Append an entry to the history."""
    HISTORY.parent.mkdir(exist_ok=True)
    with HISTORY.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def newest() -> dict[str, dict[str, Any]]:
    """Return the last entry of each benchmark, by its name."""
    if not HISTORY.exists():
        return {}
    with HISTORY.open(encoding="utf-8") as file:
        return {line["benchmark"]: line for line in map(json.loads, file)}


def _cpu_model() -> str:
    """Return the processor's name in /proc/cpuinfo."""
    lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


def _version(package: str) -> str:
    """Return the version of an installed package, or "not installed"."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _revision() -> str:
    """Return the revision of the sources, with a + if they have changes; "unknown" without git."""
    command = ["git", "describe", "--always", "--dirty=+", "--abbrev=10"]
    try:
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"

"""Benchmarks of commands that read a recording: replay and export, as an operator starts them."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from tests.benchmarks.configurations import PAPER
from tests.benchmarks.measure import Effort, interleave, spread
from tests.benchmarks.processes import RATE_HZ, rtloop

RECORDED_S, REPLAYED_S = 180.0, 600.0
FORMATS = ("csv", "npz", "parquet")


def make_recording(folder: Path, duration_s: float) -> Path:
    """Run the paper's loop in virtual time; return its recording."""
    summary, _ = rtloop("run", PAPER, "--unpaced", "--duration", str(duration_s), "--out", folder)
    return Path(summary["recording"])


def replay(effort: Effort) -> dict[str, Any]:
    """`rtloop replay` on ten minutes of the paper's loop, with every output of every tick compared in bytes: times
    real time of the whole command, start of the interpreter included, with one process and with two in turn.
    """
    duration_s = effort.duration_s(REPLAYED_S)
    with tempfile.TemporaryDirectory() as name:
        path = make_recording(Path(name), duration_s)
        jobs = {"one_process": 1, "two_processes": 2}
        commands = {key: partial(_replay, path, duration_s, count) for key, count in jobs.items()}
        walls_by_jobs = {key: walls[1:] for key, walls in interleave(commands, effort.pairs + 1).items()}
    results: dict[str, Any] = {
        key: {"wall_s": spread(walls), "times_real_time": spread([duration_s / wall_s for wall_s in walls])}
        for key, walls in walls_by_jobs.items()
    }
    results["scaling"] = spread([one_s / two_s for one_s, two_s in zip(*walls_by_jobs.values(), strict=True)])
    return results


def _replay(path: Path, duration_s: float, jobs: int) -> float:
    """Replay a recording with `jobs` processes; return the wall time in s. Raises RuntimeError if it differs."""
    report, wall_s = rtloop("replay", path, "--jobs", str(jobs))
    if report["ticks"] != round(duration_s * RATE_HZ) or not report["identical"]:
        raise RuntimeError(f"replay: {report}")
    return wall_s


def export(effort: Effort) -> dict[str, Any]:
    """`rtloop export` of three minutes of the paper's loop, one format after the other: times real time of the whole
    command, and bytes a tick. CSV has every number as the shortest text that reads back to it.
    """
    duration_s = effort.duration_s(RECORDED_S)
    with tempfile.TemporaryDirectory() as name:
        path = make_recording(Path(name), duration_s)
        actions = {format_name: partial(_export, path, format_name) for format_name in FORMATS}
        outcomes = interleave(actions, effort.pairs)
    ticks = round(duration_s * RATE_HZ)
    results: dict[str, Any] = {}
    for format_name, exports in outcomes.items():
        if any(report["ticks"] != ticks for report, _ in exports):
            raise RuntimeError(f"export: not {ticks} ticks")
        rates = [duration_s / wall_s for _, wall_s in exports]
        results[format_name] = {"times_real_time": spread(rates), "bytes_per_tick": exports[0][0]["bytes"] / ticks}
    return results


def _export(path: Path, format_name: str) -> tuple[dict[str, Any], float]:
    """Export a recording and delete the output; return the command's report and its wall time in s."""
    report, wall_s = rtloop("export", path, "--to", format_name)
    Path(report["output"]).unlink()
    return report, wall_s

"""Reading a recording again: replay and export, as an operator starts them."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from tests.benchmarks.configurations import PAPER
from tests.benchmarks.measure import Effort, in_turn, spread
from tests.benchmarks.processes import RATE_HZ, rtloop

RECORDED_S, REPLAYED_S = 180.0, 600.0
FORMATS = ("csv", "npz", "parquet")


def recording(folder: Path, duration_s: float) -> Path:
    """A run in virtual time."""
    summary, _ = rtloop("run", PAPER, "--unpaced", "--duration", str(duration_s), "--out", folder)
    return Path(summary["recording"])


def replay(effort: Effort) -> dict[str, Any]:
    """`rtloop replay` on ten minutes of the paper's loop, with every output of every tick compared in bytes: times
    real time of the whole command, start of the interpreter included, with one process and with two in turn.
    """
    duration_s = effort.seconds(REPLAYED_S)
    with tempfile.TemporaryDirectory() as name:
        path = recording(Path(name), duration_s)
        jobs = {"one_process": 1, "two_processes": 2}
        commands = {key: partial(_replayed, path, duration_s, count) for key, count in jobs.items()}
        taken = {key: walls[1:] for key, walls in in_turn(commands, effort.pairs + 1).items()}
    found: dict[str, Any] = {
        key: {"wall_s": spread(walls), "times_real_time": spread([duration_s / wall_s for wall_s in walls])}
        for key, walls in taken.items()
    }
    found["scaling"] = spread([one / two for one, two in zip(*taken.values(), strict=True)])
    return found


def _replayed(path: Path, duration_s: float, jobs: int) -> float:
    report, wall_s = rtloop("replay", path, "--jobs", str(jobs))
    if report["ticks"] != round(duration_s * RATE_HZ) or not report["identical"]:
        raise RuntimeError(f"replay: {report}")
    return wall_s


def export(effort: Effort) -> dict[str, Any]:
    """`rtloop export` of three minutes of the paper's loop, one format after the other: times real time of the whole
    command, and bytes a tick. CSV has every number as the shortest text that reads back to it.
    """
    duration_s = effort.seconds(RECORDED_S)
    with tempfile.TemporaryDirectory() as name:
        path = recording(Path(name), duration_s)
        taken = in_turn({to: partial(_exported, path, to) for to in FORMATS}, effort.pairs)
    ticks = round(duration_s * RATE_HZ)
    found: dict[str, Any] = {}
    for to, results in taken.items():
        if any(report["ticks"] != ticks for report, _ in results):
            raise RuntimeError(f"export: not {ticks} ticks")
        rates = [duration_s / wall_s for _, wall_s in results]
        found[to] = {"times_real_time": spread(rates), "bytes_per_tick": results[0][0]["bytes"] / ticks}
    return found


def _exported(path: Path, to: str) -> tuple[dict[str, Any], float]:
    report, wall_s = rtloop("export", path, "--to", to)
    Path(report["output"]).unlink()
    return report, wall_s

"""The whole program: `rtloop run` as an operator starts it, with loop, recorder and supervisor as processes."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.benchmarks.measure import Spread
from tests.benchmarks.scenario import PAPER

ROOT = Path(__file__).parents[2]
RATE_HZ = 10_000
REPEATS = 3
UNPACED_S, PACED_S = 100.0, 10.0
ONE_TICK_S = 1 / RATE_HZ


def run(duration_s: float, *, paced: bool) -> dict[str, Any]:
    """The summary of one run of the paper's loop, and its wall time as `wall_s`."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "rtloop", "run", str(PAPER), "--json"]
        command += ["--duration", str(duration_s), "--out", folder, *([] if paced else ["--unpaced"])]
        begin = time.perf_counter()
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        return json.loads(done.stdout) | {"wall_s": time.perf_counter() - begin}


def recorded() -> dict[str, Any]:
    """Unpaced with recording: times real time from the first tick on, the end of a run of one tick taken off."""
    run(ONE_TICK_S, paced=False)
    rates = []
    for _ in range(REPEATS):
        end_s = _since_first_tick(run(ONE_TICK_S, paced=False))
        summary = run(UNPACED_S, paced=False)
        if summary["ticks_lost"] or summary["ticks_logged"] != round(UNPACED_S * RATE_HZ):
            raise AssertionError(f"{summary['ticks_lost']} ticks lost, {summary['ticks_logged']} logged")
        rates.append(UNPACED_S / (_since_first_tick(summary) - end_s))
    return {"times_real_time": Spread.of(rates)._asdict()}


def _since_first_tick(summary: dict[str, Any]) -> float:
    return summary["wall_s"] - summary["startup_s"]


def recorder() -> dict[str, Any]:
    """At 10 kHz, paced: the recorder's share of a processor in %, its start taken off, and bytes a tick."""
    shares, sizes = [], []
    for _ in range(REPEATS):
        start_s = run(ONE_TICK_S, paced=True)["recorder"]["cpu_s"]
        summary = run(PACED_S, paced=True)
        shares.append(100 * (summary["recorder"]["cpu_s"] - start_s) / PACED_S)
        sizes.append(summary["bytes_per_tick"])
    return {"cpu_percent": Spread.of(shares)._asdict(), "bytes_per_tick": Spread.of(sizes)._asdict()}


def start() -> dict[str, Any]:
    """Warm start: seconds of a whole run of one tick, and from its beginning to the first tick as it reports them."""
    run(ONE_TICK_S, paced=True)
    summaries = [run(ONE_TICK_S, paced=True) for _ in range(REPEATS)]
    return {
        "run_of_one_tick_s": Spread.of([summary["wall_s"] for summary in summaries])._asdict(),
        "to_first_tick_s": Spread.of([summary["startup_s"] for summary in summaries])._asdict(),
    }

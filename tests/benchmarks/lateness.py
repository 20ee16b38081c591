"""How late the loop wakes beside cyclictest, and how soon after a reading it writes: real processes, paced."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.configurations import changed, last_cpu, pinned
from tests.benchmarks.measure import Effort, NotMeasured, in_turn, ratio, spread
from tests.benchmarks.processes import RATE_HZ, paced_run

RUN_S = 4.0
SPIN_US = 60.0
PRIORITY = 80
HISTOGRAM_NS = 1_000_000
QUANTILES = {"p50": 0.5, "p99": 0.99}


def cyclictest(cpu: int, loops: int) -> dict[str, float]:
    """p50 and p99 of its latencies in µs. It holds /dev/cpu_dma_latency at 0 and locks its memory, as the loop does."""
    return quantiles_us(*_latencies_ns(cpu, loops, 1_000_000 // RATE_HZ))


def cycles_beyond(cpu: int, loops: int, limit_us: float) -> float:
    """The share of cyclictest's cycles whose latency exceeds `limit_us`, which is also the interval."""
    histogram_ns, cycles = _latencies_ns(cpu, loops, round(limit_us))
    return 1.0 - sum(count for value, count in histogram_ns.items() if value <= 1000 * limit_us) / cycles


def _latencies_ns(cpu: int, loops: int, interval_us: int) -> tuple[dict[int, int], int]:
    """The number of cycles by latency in ns, up to HISTOGRAM_NS, and of all cycles. Raises NotMeasured."""
    if shutil.which("cyclictest") is None:
        raise NotMeasured("cyclictest is not installed; Debian has it in the package rt-tests")
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "cyclictest.json"
        command = ["cyclictest", f"--interval={interval_us}", f"--priority={PRIORITY}", f"--affinity={cpu}"]
        command += ["--threads=1", "--mlockall", "--quiet", "--nsecs", f"--histogram={HISTOGRAM_NS}"]
        command += [f"--loops={loops}", f"--json={result}"]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if done.returncode != 0:
            raise NotMeasured(f"cyclictest ended with {done.returncode}: {done.stderr.strip()}")
        thread = json.loads(result.read_text())["thread"]["0"]
    return {int(value): count for value, count in thread["histogram"].items()}, thread["cycles"]


def quantiles_us(histogram_ns: Mapping[int, int], cycles: int) -> dict[str, float]:
    """The smallest latency that at least this share of all cycles, those beyond the histogram too, does not exceed."""
    latencies_ns = np.array(sorted(histogram_ns))
    below = np.cumsum([histogram_ns[value] for value in latencies_ns])
    ranks = {name: np.searchsorted(below, quantile * cycles) for name, quantile in QUANTILES.items()}
    return {name: float(latencies_ns[min(rank, below.size - 1)]) / 1000 for name, rank in ranks.items()}


def _lateness(text: str, duration_s: float) -> dict[str, float]:
    return paced_run(duration_s, text)["lateness_us"]


def lateness(effort: Effort) -> dict[str, Any]:
    """Wake after the deadline in µs at 10 kHz: of the recorded ticks of `rtloop run`, sleeping (spin_us = 0) and
    spinning for the last 60 µs, and of cyclictest at the same interval, priority and processor. The table has p50
    and p99 of each run, and ratios to cyclictest, round by round.
    """
    cpu, duration_s = last_cpu(), effort.seconds(RUN_S)
    runs = in_turn(
        {
            "cyclictest": partial(cyclictest, cpu, round(duration_s * RATE_HZ)),
            "sleeping": partial(_lateness, changed(*pinned(cpu)), duration_s),
            "spinning": partial(_lateness, changed(*pinned(cpu, SPIN_US)), duration_s),
        },
        effort.pairs,
    )
    found: dict[str, Any] = {}
    for name, reports in runs.items():
        values = {quantile: [report[quantile] for report in reports] for quantile in QUANTILES}
        found[name] = {f"{quantile}_us": spread(several) for quantile, several in values.items()}
        if name != "cyclictest":
            beside = {quantile: [report[quantile] for report in runs["cyclictest"]] for quantile in QUANTILES}
            ratios = {f"{quantile}_ratio": ratio(values[quantile], beside[quantile]) for quantile in QUANTILES}
            found[name] |= ratios
    return found


def latency(effort: Effort) -> dict[str, Any]:
    """Durations within a paced tick on the simulated rig in µs, medians over the ticks of a run.

    - `read`, `write`: the driver's functions.
    - `read_to_write`: from the end of the read to the begin of the write (interlocks, reference, law, and one
      reading of the clock).
    - `tick`: from the wake to the record.
    """
    cpu, duration_s = last_cpu(), effort.seconds(RUN_S)
    configurations = {"sleeping": changed(*pinned(cpu)), "spinning": changed(*pinned(cpu, SPIN_US))}
    runs = in_turn({name: partial(paced_run, duration_s, text) for name, text in configurations.items()}, effort.pairs)
    return {name: _phases(reports) for name, reports in runs.items()}


def _phases(reports: list[dict[str, Any]]) -> dict[str, Any]:
    names = {"read_us": "read_us", "read_to_write_us": "law_us", "write_us": "write_us"}
    phases = {name: spread([report["phases"][signal] for report in reports]) for name, signal in names.items()}
    return phases | {"tick_us": spread([report["exec_us"]["p50"] for report in reports])}

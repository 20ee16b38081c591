"""Lateness of the loop's wakes compared with cyclictest, and time from reading to output, in real paced processes."""

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
from tests.benchmarks.measure import Effort, MeasurementUnavailable, interleave, ratio, spread
from tests.benchmarks.processes import RATE_HZ, paced_run

RUN_S = 4.0
SPIN_US = 60.0
PRIORITY = 80
HISTOGRAM_NS = 1_000_000
QUANTILES = {"p50": 0.5, "p99": 0.99}


def cyclictest(cpu: int, loops: int) -> dict[str, float]:
    """Run cyclictest, with locked memory and /dev/cpu_dma_latency at 0 like the loop; return p50 and p99 in µs."""
    return quantiles_us(*_latencies_ns(cpu, loops, 1_000_000 // RATE_HZ))


def late_cycle_share(cpu: int, loops: int, limit_us: float) -> float:
    """Return the share of cyclictest's cycles whose latency exceeds `limit_us`, which is also its interval."""
    histogram_ns, cycles = _latencies_ns(cpu, loops, round(limit_us))
    return 1.0 - sum(count for value, count in histogram_ns.items() if value <= 1000 * limit_us) / cycles


def _latencies_ns(cpu: int, loops: int, interval_us: int) -> tuple[dict[int, int], int]:
    """Run cyclictest; return the count of cycles by latency (ns, up to HISTOGRAM_NS) and the count of all cycles.

    Raises MeasurementUnavailable.
    """
    if shutil.which("cyclictest") is None:
        raise MeasurementUnavailable("cyclictest is not installed; Debian has it in the package rt-tests")
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "cyclictest.json"
        command = ["cyclictest", f"--interval={interval_us}", f"--priority={PRIORITY}", f"--affinity={cpu}"]
        command += ["--threads=1", "--mlockall", "--quiet", "--nsecs", f"--histogram={HISTOGRAM_NS}"]
        command += [f"--loops={loops}", f"--json={result}"]
        completed = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if completed.returncode != 0:
            raise MeasurementUnavailable(f"cyclictest ended with {completed.returncode}: {completed.stderr.strip()}")
        thread = json.loads(result.read_text())["thread"]["0"]
    return {int(value): count for value, count in thread["histogram"].items()}, thread["cycles"]


def quantiles_us(histogram_ns: Mapping[int, int], cycles: int) -> dict[str, float]:
    """Return p50 and p99 of latencies in µs; `cycles` also counts latencies beyond the histogram, as its largest."""
    latencies_ns = np.array(sorted(histogram_ns))
    cumulative_counts = np.cumsum([histogram_ns[value] for value in latencies_ns])
    ranks = {name: np.searchsorted(cumulative_counts, quantile * cycles) for name, quantile in QUANTILES.items()}
    return {name: float(latencies_ns[min(rank, cumulative_counts.size - 1)]) / 1000 for name, rank in ranks.items()}


def _loop_lateness_us(text: str, duration_s: float) -> dict[str, float]:
    """Run the loop; return the quantiles of its lateness in µs."""
    return paced_run(duration_s, text)["lateness_us"]


def lateness(effort: Effort) -> dict[str, Any]:
    """Wake after the deadline in µs at 10 kHz: of the recorded ticks of `rtloop run`, sleeping (spin_us = 0) and
    spinning for the last 60 µs, and of cyclictest at the same interval, priority and processor. The table has p50
    and p99 of each run, and ratios to cyclictest, round by round.
    """
    cpu, duration_s = last_cpu(), effort.duration_s(RUN_S)
    runs = interleave(
        {
            "cyclictest": partial(cyclictest, cpu, round(duration_s * RATE_HZ)),
            "sleeping": partial(_loop_lateness_us, changed(*pinned(cpu)), duration_s),
            "spinning": partial(_loop_lateness_us, changed(*pinned(cpu, SPIN_US)), duration_s),
        },
        effort.pairs,
    )
    results: dict[str, Any] = {}
    for name, reports in runs.items():
        values = {quantile: [report[quantile] for report in reports] for quantile in QUANTILES}
        results[name] = {f"{quantile}_us": spread(of_runs) for quantile, of_runs in values.items()}
        if name != "cyclictest":
            baseline = {quantile: [report[quantile] for report in runs["cyclictest"]] for quantile in QUANTILES}
            ratios = {f"{quantile}_ratio": ratio(values[quantile], baseline[quantile]) for quantile in QUANTILES}
            results[name] |= ratios
    return results


def latency(effort: Effort) -> dict[str, Any]:
    """Durations within a paced tick on the simulated rig in µs, medians over the ticks of a run.

    - `read`, `write`: the driver's functions.
    - `read_to_write`: from the end of the read to the begin of the write (interlocks, reference, law, and one
      reading of the clock).
    - `tick`: from the wake to the record.
    """
    cpu, duration_s = last_cpu(), effort.duration_s(RUN_S)
    configurations = {"sleeping": changed(*pinned(cpu)), "spinning": changed(*pinned(cpu, SPIN_US))}
    actions = {name: partial(paced_run, duration_s, text) for name, text in configurations.items()}
    runs = interleave(actions, effort.pairs)
    return {name: _phases(reports) for name, reports in runs.items()}


def _phases(reports: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the spreads of the phases of a tick (µs), from the summaries of several runs."""
    names = {"read_us": "read_us", "read_to_write_us": "law_us", "write_us": "write_us"}
    phases = {name: spread([report["phases"][signal] for report in reports]) for name, signal in names.items()}
    return phases | {"tick_us": spread([report["exec_us"]["p50"] for report in reports])}

"""Benchmarks of the program `rtloop` as an operator starts it, with loop, recorder and supervisor as processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from tests.benchmarks.configurations import PAPER, ROOT, TEXT, write
from tests.benchmarks.measure import Effort, MeasurementUnavailable, spread

RATE_HZ = 10_000
UNPACED_S, PACED_S = 100.0, 10.0
EXTRA_S, SETTLE_S = 3.0, 1.0
"""Excess of a run's duration over the measured part, and wait from the open recording to the measured part."""
ONE_TICK_S = 1 / RATE_HZ
TIMEOUT_S = 600.0


class CommandFailed(RuntimeError):
    """A command ended with another code than 0."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


def rtloop(*arguments: str | Path, environment: Mapping[str, str] | None = None) -> tuple[dict[str, Any], float]:
    """Run a command with --json; return its output and its wall time in s. Raises CommandFailed."""
    command = [sys.executable, "-m", "rtloop", *map(str, arguments), "--json"]
    begin = time.perf_counter()
    completed = subprocess.run(
        command, cwd=ROOT, env=os.environ | (environment or {}), capture_output=True, text=True, timeout=TIMEOUT_S
    )
    wall_s = time.perf_counter() - begin
    if completed.returncode != 0:
        message = completed.stderr.strip() or completed.stdout
        raise CommandFailed(f"{' '.join(command)} ended with {completed.returncode}: {message}", completed.returncode)
    return json.loads(completed.stdout), wall_s


def run(duration_s: float, *, paced: bool, text: str = TEXT) -> dict[str, Any]:
    """Run a configuration and delete the recording; return the summary with the wall time `wall_s`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = PAPER if text is TEXT else write(folder, text)
        pacing = [] if paced else ["--unpaced"]
        summary, wall_s = rtloop("run", config, "--duration", str(duration_s), "--out", folder, *pacing)
    if summary["ticks_lost"] or summary["ticks_logged"] != round(duration_s * summary["rate_hz"]):
        raise RuntimeError(f"{summary['ticks_lost']} ticks lost, {summary['ticks_logged']} logged")
    return summary | {"wall_s": wall_s}


def paced_run(duration_s: float, text: str = TEXT) -> dict[str, Any]:
    """Like `run`, paced. Raises MeasurementUnavailable if the host refuses real-time scheduling."""
    summary = run(duration_s, paced=True, text=text)
    if summary["realtime"]["scheduler"] != "SCHED_FIFO":
        raise MeasurementUnavailable(f"the host refused {'; '.join(summary['realtime']['refused'])}")
    return summary


def recorded(effort: Effort) -> dict[str, Any]:
    """Unpaced with recording: times real time from the first tick on, less the end of a run of one tick."""
    run(ONE_TICK_S, paced=False)
    rates, duration_s = [], effort.duration_s(UNPACED_S)
    for _ in range(effort.pairs):
        end_s = _since_first_tick(run(ONE_TICK_S, paced=False))
        rates.append(duration_s / (_since_first_tick(run(duration_s, paced=False)) - end_s))
    return {"times_real_time": spread(rates)}


def _since_first_tick(summary: dict[str, Any]) -> float:
    """Return the seconds from the first tick to the end of the command."""
    return summary["wall_s"] - summary["startup_s"]


def recorder(effort: Effort) -> dict[str, Any]:
    """At 10 kHz, paced: the recorder's share of a processor in % while it records, by the kernel's account of its
    thread, and bytes a tick of the whole file.
    """
    shares, sizes, duration_s = [], [], effort.duration_s(PACED_S)
    for _ in range(effort.pairs):
        with ThreadPoolExecutor(1) as pool:
            run_future = pool.submit(run, duration_s + EXTRA_S, paced=True)
            shares.append(_recorder_share(run_future, duration_s))
            sizes.append(run_future.result()["bytes_per_tick"])
    return {"cpu_percent": spread(shares), "bytes_per_tick": spread(sizes)}


def _recorder_share(run_future: Future[Any], duration_s: float) -> float:
    """Return the recorder's share of a processor in % over `duration_s`, after it has opened its recording."""
    deadline_s = time.monotonic() + TIMEOUT_S
    while not (pids := _recorder_pids(os.getpid())):
        if run_future.done() or time.monotonic() > deadline_s:
            raise RuntimeError(f"recorder: no recording was opened; the run ended with {run_future.exception()}")
        time.sleep(0.05)
    time.sleep(SETTLE_S)
    begin_s, begin_ns = time.monotonic(), _cpu_ns(pids[0])
    time.sleep(duration_s)
    return (_cpu_ns(pids[0]) - begin_ns) / (time.monotonic() - begin_s) / 1e7


def _recorder_pids(ancestor: int) -> list[int]:
    """Return the grandchildren of a process that have opened a recording."""
    children = [child for pid in _children(ancestor) for child in _children(pid)]
    return [pid for pid in children if any(link.endswith(".mcap.part") for link in _open_files(pid))]


def _children(pid: int) -> list[int]:
    """Return the process ids of the children of a process."""
    pids = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):
            pids += [int(child) for child in task.read_text().split()]
    return pids


def _open_files(pid: int) -> list[str]:
    """Return the paths of the files that a process has opened."""
    links = []
    for fd in Path(f"/proc/{pid}/fd").glob("*"):
        with suppress(OSError):
            links.append(os.readlink(fd))
    return links


def _cpu_ns(pid: int) -> int:
    """Return the processor time of a process's main thread in ns."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])


def start(effort: Effort) -> dict[str, Any]:
    """Warm start: seconds of a whole run of one tick, and from its begin to the first tick, as the run reports them."""
    run(ONE_TICK_S, paced=True)
    summaries = [run(ONE_TICK_S, paced=True) for _ in range(effort.pairs)]
    return {
        "run_of_one_tick_s": spread([summary["wall_s"] for summary in summaries]),
        "to_first_tick_s": spread([summary["startup_s"] for summary in summaries]),
    }

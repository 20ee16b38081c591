"""Time of the exchange with a node over loopback: the loop's read and write, against a C program's exchange."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import rtloop
from rtloop.signals import Flag
from tests.benchmarks.configurations import RIG, ROOT, SINE, STEPS, at_rate, changed, last_cpu, pinned, write
from tests.benchmarks.measure import Effort, MeasurementUnavailable, interleave, ratio, show_progress, spread
from tests.benchmarks.rates import RATES_HZ, WINDOWS, late_shares

SECONDS, RATE_HZ = 4.0, 10_000
HOLD_US = 5_000_000
ANSWERS = {"next_tick": "next tick", "same_tick": "same tick"}
DRIVER = """[driver]
kind = "udp"
host = "127.0.0.1"
port = {port}
answer = "{answer}"
deadline_us = 90.0
watchdog_ms = 5000.0
hold_ticks = 900
error_limit = 100000
digital_inputs = 4
digital_outputs = 4
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0

"""


SPINNING, REAL_TIME = ((), ("--spin",)), (("chrt", "-f", "70"), ())
"""Words before and after the node's program in its command: of a spinning node, of a node with real-time priority."""
ALLOWED = 0.01


@contextmanager
def node_in_c(programs: Path, *, spins: bool, environment: dict[str, str] | None = None) -> Iterator[int]:
    """Run the node in C on processor 0, spinning, or asleep between frames and in real time; yield its port."""
    before, after = SPINNING if spins else REAL_TIME
    command = ["taskset", "-c", "0", *before, programs / "rtloop-node", "--port", "0", "--hold", str(HOLD_US), *after]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["port"]
        process.terminate()


def node(effort: Effort) -> dict[str, Any]:
    """µs of a tick's calls at 10 kHz, medians of ticks: read and write of `rtloop run` against send and receive of
    deploy/node/linux/exchange.c, in turn, both with SCHED_FIFO on one processor; the node in C spins on the other.

    - `calls`: in the next tick's answer there is no wait; with the same tick's the wait for the node is within.
    - `apart_from_wait`: with the same tick's answer, the loop's read and write less the exchange that it waited for.
    - `highest_hz`: the last rate of the ladder of `rates`, with the next tick's answer and a node that sleeps between
      frames, at which less than 1 % of the ticks overran or were skipped, and less than 1 % had no answer, in the
      median one-second window.
    """
    if shutil.which("cc") is None or shutil.which("make") is None:
        raise MeasurementUnavailable("a C compiler and make build the node: apt-get install build-essential")
    duration_s, results = effort.duration_s(SECONDS), dict[str, Any]()
    with tempfile.TemporaryDirectory() as name:
        programs = Path(name)
        make = ["make", "-C", ROOT / "deploy/node", "all", f"BUILD={programs}"]
        subprocess.run(make, check=True, capture_output=True)
        with node_in_c(programs, spins=True) as port:
            for key, answer in ANSWERS.items():
                actions = {
                    "rtloop": partial(_loop_us, programs, port, answer, duration_s),
                    "c": partial(_c_us, programs, port, answer, duration_s),
                }
                rounds = interleave(actions, effort.pairs)
                calls = {program: [row["calls"] for row in rows] for program, rows in rounds.items()}
                results[key] = {f"{program}_calls_us": spread(values) for program, values in calls.items()}
                results[key]["ratio"] = ratio(calls["rtloop"], calls["c"])
                results[key]["held_ticks"] = spread([row["held"] for row in rounds["rtloop"]])
                if key == "same_tick":
                    for figure in ("apart_from_wait", "exchange_p50", "exchange_p99"):
                        results[key][f"{figure}_us"] = spread([row[figure] for row in rounds["rtloop"]])
        with node_in_c(programs, spins=False) as port:
            results["highest_hz"] = _highest_hz(programs, port, max(round(effort.duration_s(WINDOWS)), 2))
    return results


def _highest_hz(folder: Path, port: int, windows: int) -> float:
    """Return the last rate (Hz) of the ladder before the first with a share of ALLOWED or more; 0 if the first has."""
    highest_hz = 0.0
    for rate_hz in RATES_HZ:
        driver, pins = DRIVER.format(port=port, answer="next tick"), pinned(last_cpu())
        recording = record(folder, windows + 0.5, (RIG, driver), at_rate(rate_hz), *pins)
        deadline_ns, flags, missed, status = recording.read("deadline_ns", "flags", "periods_missed", "driver_status")
        lost = late_shares(deadline_ns, flags, missed).lost
        held = late_shares(deadline_ns, np.where(status == 1, int(Flag.OVERRUN), 0), np.zeros_like(missed)).overrun
        show_progress(f"{rate_hz} Hz: overrun or skipped {lost:.3%}, without an answer {held:.3%}")
        if max(lost, held) >= ALLOWED:
            break
        highest_hz = float(rate_hz)
    return highest_hz


def record(folder: Path, duration_s: float, *changes: tuple[str, str]) -> rtloop.Recording:
    """Run the loop with its outputs off, and return the recording."""
    config = write(folder, changed((STEPS, SINE), ('# mode = "closed_loop"', 'mode = "off"'), *changes))
    (folder / "paper-spec.toml").write_text((ROOT / "deploy/paper-spec.toml").read_text())
    return rtloop.load(rtloop.run(config, duration_s=duration_s, folder=folder / "recordings").recordings[0])


def _loop_us(folder: Path, port: int, answer: str, duration_s: float) -> dict[str, float]:
    """Run the loop; return medians over its ticks in µs, p99 of the exchange, and the count of held ticks."""
    driver = RIG, DRIVER.format(port=port, answer=answer)
    recording = record(folder, duration_s, driver, *pinned(last_cpu()))
    read_us, write_us, exchange_us = (recording[name][100:] for name in ("read_us", "write_us", "node_exchange_us"))
    calls_us = read_us + write_us
    return {
        "calls": float(np.median(calls_us)),
        "held": float(recording["node_held_ticks"][-1]),
        "apart_from_wait": float(np.median(calls_us - exchange_us)),
        "exchange_p50": float(np.median(exchange_us)),
        "exchange_p99": float(np.percentile(exchange_us, 99)),
    }


def _c_us(programs: Path, port: int, answer: str, duration_s: float) -> dict[str, float]:
    """Run the C program; return the median over its ticks in µs."""
    command = ["taskset", "-c", str(last_cpu()), programs / "exchange", "127.0.0.1", str(port), "--rate", str(RATE_HZ)]
    options = ["--count", str(round(duration_s * RATE_HZ)), f"--{answer.replace(' ', '-')}", "--hold", str(HOLD_US)]
    options += ["--priority", "80"]
    completed = subprocess.run([*command, *options], capture_output=True, text=True)
    if completed.returncode:
        raise MeasurementUnavailable(f"exchange: {completed.stderr.strip()}")
    return {"calls": json.loads(completed.stdout)["calls_us"]["p50"]}

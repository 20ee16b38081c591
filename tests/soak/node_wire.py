"""Loop and node in C with a bad wire between them: `make soak NAME=node-wire`.

A library preloaded into the node delays its answers, or loses frames at random in both directions and logs them. The
exit code is 0 only if

- each delay lengthens the self-test's exchanges by this delay, within ALLOWED_US;
- at 10 kHz the recording shows exactly the logged losses: the tick that awaited the answer held its sample, and the
  count of lost samples rose by one for each loss. Ticks without an answer for another reason, such as a stalled
  machine, are printed and not judged.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

import rtloop
from rtloop.drivers.base import Wiring
from rtloop.drivers.node.driver import UdpDriver
from rtloop.drivers.node.options import UdpOptions
from tests.benchmarks.configurations import RIG, ROOT, at_rate, last_cpu, pinned
from tests.benchmarks.node import DRIVER, node_in_c, record

WIRE = Path(__file__).with_name("wire.c")
DELAYS_US = (100.0, 300.0, 1000.0)
ALLOWED_US = 20.0
EXCHANGES, MEASURING_HZ = 2000, 1000.0
OTHER_COUNTS = ("node_reordered_samples", "node_duplicated_samples", "node_invalid_frames", "node_foreign_frames")
"""Columns of counts that the lost frames must not raise; a stalled node may raise that of invalid frames."""


class Losses(NamedTuple):
    """Log of the preloaded library: sequence of the first DRIVE with codes, frame counts, sequences of lost frames."""

    first: int
    drives: int
    samples: int
    lost: list[int]


def build(folder: Path) -> None:
    """Compile the node and the preloaded library into the folder."""
    subprocess.run(["make", "-s", "-C", ROOT / "deploy/node", "all", f"BUILD={folder}"], check=True)
    compile_it = ["cc", "-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([*compile_it, "-o", folder / "wire.so", WIRE, "-ldl"], check=True)


def read_losses(file: Path) -> Losses:
    """Return the log in the file of the preloaded library."""
    data = file.read_bytes()
    first, count, drives, samples = struct.unpack_from("<IIQQ", data)
    return Losses(first, drives, samples, list(struct.unpack_from(f"<{count}I", data, 24)))


@contextmanager
def node(programs: Path, log: Path, loss: float = 0.0, seed: int = 1, delay_us: float = 0.0) -> Iterator[int]:
    """Run the node behind a bad wire, in real time on processor 0; yield its port."""
    environment = os.environ | {
        "LD_PRELOAD": str(programs / "wire.so"), "WIRE_FILE": str(log), "WIRE_LOSS": f"{loss:.17g}",
        "WIRE_SEED": str(seed), "WIRE_DELAY_US": f"{delay_us:g}",
    }  # fmt: skip
    with node_in_c(programs, spins=False, environment=environment) as port:
        yield port


def check_delays(programs: Path, folder: Path) -> bool:
    """Print the median exchange for each delay; return whether each delay lengthens it as much, within ALLOWED_US."""
    medians = dict[float, float]()
    for delay_us in (0.0, *DELAYS_US):
        with node(programs, folder / "delays", delay_us=delay_us) as port:
            options = {"host": "127.0.0.1", "port": port, "digital_inputs": 4, "digital_outputs": 4}
            driver = UdpDriver(UdpOptions.model_validate(options), {"x": Wiring("adc0", "dac0")}, MEASURING_HZ)
            medians[delay_us] = median(driver.measure_exchanges(EXCHANGES).durations_us)
        error_us = medians[delay_us] - medians[0.0] - delay_us
        print(f"delay {delay_us:5.0f} µs: exchange {medians[delay_us]:7.1f} µs, error {error_us:5.1f} µs", flush=True)
    return all(abs(medians[delay_us] - medians[0.0] - delay_us) <= ALLOWED_US for delay_us in DELAYS_US)


def dropped_by_system(port: int) -> int:
    """Return how many datagrams Linux has dropped at a UDP port because its program did not read them."""
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return sum(int(row[-1]) for row in rows if int(row[1].rpartition(":")[2], 16) == port)


def judge(recording: rtloop.Recording, losses: Losses, overflows: int) -> dict[str, Any]:
    """Return the figures of a run; `good`: each logged loss held its tick, and each lost answer is explained.

    Linux drops drives while the node stands still; an answer to a drive more than a thousand drives old is invalid.
    """
    ticks, lost_samples, status, exchange_us, periods_missed = recording.read(
        "tick", "node_lost_samples", "driver_status", "node_exchange_us", "periods_missed"
    )
    held_ticks = set(ticks[status == 1].astype(int).tolist())
    # Tick k sends the drive first + k; the next tick awaits its answer.
    due_ticks = {sequence - losses.first + 1 for sequence in losses.lost}
    due_ticks = {tick for tick in due_ticks if tick <= ticks[-1]}
    other_counts = {name: int(recording[name][-1]) for name in OTHER_COUNTS}
    is_last_due = int(ticks[-1]) in due_ticks  # The last answer counts as lost with the next sample only.
    explained_losses = len(due_ticks) - is_last_due + overflows + other_counts["node_invalid_frames"]
    is_good = due_ticks <= held_ticks and int(lost_samples[-1]) == explained_losses
    is_good = is_good and not any(other_counts[name] for name in OTHER_COUNTS if name != "node_invalid_frames")
    return {
        "good": is_good, "ticks": len(ticks), "ticks_not_recorded": int(ticks[-1] - ticks[0]) + 1 - len(ticks),
        "datagrams": losses.drives + losses.samples, "lost_by_network": len(losses.lost),
        "dropped_by_system": overflows, "lost_by_loop": int(lost_samples[-1]), "held_ticks": len(held_ticks),
        "held_without_loss": len(held_ticks - due_ticks), "periods_missed": int(np.sum(periods_missed)),
        "exchange_p50_us": round(float(np.median(exchange_us)), 2),
        "exchange_p99_us": round(float(np.percentile(exchange_us, 99)), 2), **other_counts,
    }  # fmt: skip


def main() -> None:
    """Check the delays, then a run with losses; print the figures and exit with 1 for a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--datagrams", type=float, default=1e7, help="in both directions")
    parser.add_argument("--rate-hz", type=float, default=10_000.0)
    parser.add_argument("--loss", type=float, default=1e-6, help="share of the datagrams")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=["delays", "losses"], help="by default both")
    options = parser.parse_args()
    passed = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        programs = folder / "programs"
        build(programs)
        if options.only != "losses":
            passed &= check_delays(programs, folder)
        if options.only != "delays":
            with node(programs, folder / "losses", loss=options.loss, seed=options.seed) as port:
                driver = RIG, DRIVER.format(port=port, answer="next tick")
                duration_s = options.datagrams / 2 / options.rate_hz
                changes = at_rate(options.rate_hz), *pinned(last_cpu())
                recording = record(folder, duration_s, driver, *changes)
                overflows = dropped_by_system(port)
            figures = judge(recording, read_losses(folder / "losses"), overflows)
            print(json.dumps(figures, indent=1))
            passed &= figures["good"]
    sys.exit(0 if passed else 1)


if __name__ == "__main__":
    main()

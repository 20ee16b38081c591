"""Loop and node in C with a bad wire between them: `make soak NAME=node-wire`.

A library preloaded into the node delays its answers, or loses frames at random in both directions and writes down
which. Exit code 0 only if

- each delay is what the self-test's exchanges take longer, within ALLOWED_US;
- at 10 kHz the recording shows exactly the losses: the tick that awaited the answer held its sample, and the count of
  lost ones rose once for each. Ticks without their answer for another reason, such as a machine that stalled, are shown
  and not judged.
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
NEVER = ("node_reordered_samples", "node_duplicated_samples", "node_invalid_frames", "node_foreign_frames")


class Losses(NamedTuple):
    """What the preloaded library wrote: the first DRIVE with codes, frames that came to it, sequences of lost ones."""

    first: int
    drives: int
    samples: int
    lost: list[int]


def build(folder: Path) -> None:
    """Compile the node and the library below the folder."""
    subprocess.run(["make", "-s", "-C", ROOT / "deploy/node", "all", f"BUILD={folder}"], check=True)
    compile_it = ["cc", "-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([*compile_it, "-o", folder / "wire.so", WIRE, "-ldl"], check=True)


def read_losses(file: Path) -> Losses:
    """Return what the library wrote."""
    data = file.read_bytes()
    first, count, drives, samples = struct.unpack_from("<IIQQ", data)
    return Losses(first, drives, samples, list(struct.unpack_from(f"<{count}I", data, 24)))


@contextmanager
def node(programs: Path, log: Path, loss: float = 0.0, seed: int = 1, delay_us: float = 0.0) -> Iterator[int]:
    """Run the node behind a bad wire, on processor 0 before all that does not run in real time; yield its port."""
    environment = os.environ | {
        "LD_PRELOAD": str(programs / "wire.so"), "WIRE_FILE": str(log), "WIRE_LOSS": f"{loss:.17g}",
        "WIRE_SEED": str(seed), "WIRE_DELAY_US": f"{delay_us:g}",
    }  # fmt: skip
    with node_in_c(programs, spins=False, environment=environment) as port:
        yield port


def delays_are_kept(programs: Path, folder: Path) -> bool:
    """Print the median exchange for each delay; return whether it is longer than without by the delay."""
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
    """Return how many datagrams Linux has dropped at a UDP port, because its program stood still."""
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return sum(int(row[-1]) for row in rows if int(row[1].rpartition(":")[2], 16) == port)


def judge(recording: rtloop.Recording, losses: Losses, overflows: int) -> dict[str, Any]:
    """Return the figures of a run, with `good`: whether each loss is where it must be, and each lost answer explained.

    Linux drops drives of a node that stands still; an answer to one of more than a thousand drives ago is invalid.
    """
    ticks, lost, status, exchange_us, missed = recording.read(
        "tick", "node_lost_samples", "driver_status", "node_exchange_us", "periods_missed"
    )
    held = set(ticks[status == 1].astype(int).tolist())
    # Tick k sends the drive first + k; the next tick awaits its answer.
    due = {sequence - losses.first + 1 for sequence in losses.lost}
    due = {tick for tick in due if tick <= ticks[-1]}
    others = {name: int(recording[name][-1]) for name in NEVER}
    is_unknown = int(ticks[-1]) in due  # The last answer counts as lost with the next sample only.
    explained = len(due) - is_unknown + overflows + others["node_invalid_frames"]
    good = due <= held and int(lost[-1]) == explained
    good = good and not any(others[name] for name in NEVER if name != "node_invalid_frames")
    return {
        "good": good, "ticks": len(ticks), "ticks_not_recorded": int(ticks[-1] - ticks[0]) + 1 - len(ticks),
        "datagrams": losses.drives + losses.samples, "lost_by_network": len(losses.lost),
        "dropped_by_system": overflows, "lost_by_loop": int(lost[-1]), "held_ticks": len(held),
        "held_without_loss": len(held - due), "periods_missed": int(np.sum(missed)),
        "exchange_p50_us": round(float(np.median(exchange_us)), 2),
        "exchange_p99_us": round(float(np.percentile(exchange_us, 99)), 2), **others,
    }  # fmt: skip


def main() -> None:
    """Measure the delays, then run with losses; print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--datagrams", type=float, default=1e7, help="in both directions")
    parser.add_argument("--rate-hz", type=float, default=10_000.0)
    parser.add_argument("--loss", type=float, default=1e-6, help="share of the datagrams")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=["delays", "losses"], help="by default both")
    given = parser.parse_args()
    good = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        programs = folder / "programs"
        build(programs)
        if given.only != "losses":
            good &= delays_are_kept(programs, folder)
        if given.only != "delays":
            with node(programs, folder / "losses", loss=given.loss, seed=given.seed) as port:
                driver = RIG, DRIVER.format(port=port, answer="next tick")
                duration_s, changes = given.datagrams / 2 / given.rate_hz, (at_rate(given.rate_hz), *pinned(last_cpu()))
                recording = record(folder, duration_s, driver, *changes)
                overflows = dropped_by_system(port)
            found = judge(recording, read_losses(folder / "losses"), overflows)
            print(json.dumps(found, indent=1))
            good &= found["good"]
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()

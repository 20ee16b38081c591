"""Eight clients on the control API beside a paced run: does the loop notice? `make soak NAME=api-flood`.

Quiet and flooded intervals alternate in one run, so that what the host does meanwhile falls on both.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import rtloop
from rtloop.errors import RtloopError
from tests.faults.account import account
from tests.faults.bench import Bench
from tests.faults.configuration import PAPER

CLIENTS = 8
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}


def flood(bench: Bench, over: threading.Event, answered: list[int], number: int) -> None:
    """Ask for the status and set the reference, without a pause."""
    while not over.is_set():
        try:
            bench.client.get("/status")
            bench.client.post("/setpoint", {"axis": "x", "value": 10.0 + number})
            answered[number] += 2
        except RtloopError:
            time.sleep(0.001)


def intervals(bench: Bench, count: int, seconds: float) -> tuple[list[tuple[int, int, bool]], int]:
    """(first tick, last tick, flooded) of each interval, and the requests that were answered."""
    found, answered = [], [0] * CLIENTS
    for number in range(2 * count):
        flooded, over, first = number % 2 == 1, threading.Event(), bench.ticks
        threads = [threading.Thread(target=flood, args=(bench, over, answered, i)) for i in range(CLIENTS * flooded)]
        for thread in threads:
            thread.start()
        over.wait(seconds)
        found.append((first, bench.ticks, flooded))
        over.set()
        for thread in threads:
            thread.join()
    return found, sum(answered)


def report(recording: rtloop.Recording, found: list[tuple[int, int, bool]], seconds: float) -> None:
    """Lateness and missed periods side by side."""
    lateness_us, missed = recording.read("lateness_us", "periods_missed")
    print(f"{'lateness in µs':24}" + "".join(f"{name:>10}" for name in QUANTILES) + f"{'missed':>10}")
    for flooded in (False, True):
        parts = [slice(first, last) for first, last, kind in found if kind == flooded]
        values = np.concatenate([lateness_us[part] for part in parts])
        row = "".join(f"{np.quantile(values, q):10.1f}" for q in QUANTILES.values())
        name = f"{CLIENTS} clients" if flooded else "quiet"
        print(f"{f'{name}, {len(parts)} x {seconds:g} s':24}{row}{int(sum(missed[part].sum() for part in parts)):10d}")


def main() -> None:
    """Run, print, and fail if a tick was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of an interval")
    parser.add_argument("--alternations", type=int, default=6)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        text = PAPER.replace('folder = "recordings"', f'folder = "{folder}/recordings"')
        text = text.replace("[recording]", "[service]\nstall_ms = 2000.0\n[recording]")
        with Bench(folder, text=text, board=False) as bench:
            found, answered = intervals(bench, given.alternations, given.seconds)
            assert bench.stop() == 0, bench.log()
            total = account(folder / "recordings", bench.blocks)
            report(rtloop.load(list((folder / "recordings").glob("*.mcap"))), found, given.seconds)
        print(
            f"requests answered: {answered}; ticks {total.executed}, lost {total.lost}; {total.problems or 'replays'}"
        )
        assert total.lost == 0
        assert not total.problems


if __name__ == "__main__":
    main()

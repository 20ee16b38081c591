"""Eight clients call the control API beside a paced run, which must not lose a tick. `make soak NAME=api-flood`.

Quiet and flooded intervals alternate in one run, so that disturbances by the host affect both.
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


def flood(bench: Bench, end: threading.Event, answer_counts: list[int], client: int) -> None:
    """Read the status and set the reference without a pause until `end` is set; count the answers of this client."""
    while not end.is_set():
        try:
            bench.client.get("/status")
            bench.client.post("/setpoint", {"axis": "x", "value": 10.0 + client})
            answer_counts[client] += 2
        except RtloopError:
            time.sleep(0.001)


def alternate_intervals(bench: Bench, count: int, seconds: float) -> tuple[list[tuple[int, int, bool]], int]:
    """Run `count` quiet and `count` flooded intervals.

    Return (first tick, last tick, flooded) of each, and the number of answered requests.
    """
    spans, answer_counts = [], [0] * CLIENTS
    for number in range(2 * count):
        flooded, end, first = number % 2 == 1, threading.Event(), bench.ticks
        threads = [
            threading.Thread(target=flood, args=(bench, end, answer_counts, i)) for i in range(CLIENTS * flooded)
        ]
        for thread in threads:
            thread.start()
        end.wait(seconds)
        spans.append((first, bench.ticks, flooded))
        end.set()
        for thread in threads:
            thread.join()
    return spans, sum(answer_counts)


def print_lateness(recording: rtloop.Recording, spans: list[tuple[int, int, bool]], seconds: float) -> None:
    """Print quantiles of the lateness and the missed periods, of quiet and of flooded intervals."""
    lateness_us, missed = recording.read("lateness_us", "periods_missed")
    print(f"{'lateness in µs':24}" + "".join(f"{label:>10}" for label in QUANTILES) + f"{'missed':>10}")
    for flooded in (False, True):
        slices = [slice(first, last) for first, last, is_flooded in spans if is_flooded == flooded]
        values = np.concatenate([lateness_us[ticks] for ticks in slices])
        row = "".join(f"{np.quantile(values, q):10.1f}" for q in QUANTILES.values())
        label = f"{CLIENTS} clients" if flooded else "quiet"
        missed_count = int(sum(missed[ticks].sum() for ticks in slices))
        print(f"{f'{label}, {len(slices)} x {seconds:g} s':24}{row}{missed_count:10d}")


def main() -> None:
    """Run and print the lateness. Raises AssertionError if a tick was lost or the recording does not replay."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of an interval")
    parser.add_argument("--alternations", type=int, default=6)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        text = PAPER.replace('folder = "recordings"', f'folder = "{folder}/recordings"')
        text = text.replace("[recording]", "[service]\nstall_ms = 2000.0\n[recording]")
        with Bench(folder, text=text, board=False) as bench:
            spans, answered = alternate_intervals(bench, options.alternations, options.seconds)
            assert bench.stop() == 0, bench.log()
            ticks = account(folder / "recordings", bench.blocks)
            print_lateness(rtloop.load(list((folder / "recordings").glob("*.mcap"))), spans, options.seconds)
        print(
            f"requests answered: {answered}; ticks {ticks.executed}, lost {ticks.lost}; "
            f"{ticks.problems or 'all runs replay'}"
        )
        assert ticks.lost == 0
        assert not ticks.problems


if __name__ == "__main__":
    main()

"""Swaps of gain, controller and mode through the API of a real service, 10 kHz, under a sine. `make soak-swaps`."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

import rtloop
from rtloop.configuration.file import parse
from tests.engine.test_swaps import SINE
from tests.faults.account import account
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for
from tests.recording.real_loop import changed

QUIET_TICKS = 30_000


def swap(bench: Bench, number: int, controller: dict) -> int:
    """One of the three, in turn; the tick at which it took effect."""
    client = bench.client
    if number % 3 == 0:
        gain = 0.013 if number % 2 else 0.016
        return client.post("/tune", {"axis": "x", "section": "controller", "values": {"gain": gain}})["tick"]
    if number % 3 == 1:
        other = controller | ({"method": "matched", "prewarp_hz": None} if number % 2 else {})
        return client.post("/controller", {"axis": "x", "controller": other})["tick"]
    client.post("/mode", {"mode": "feedforward"})
    return client.post("/mode", {"mode": "closed_loop"})["tick"]


def main() -> None:
    """Run, print, and fail where a swap bumps or the replay differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--swaps", type=int, default=200)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        text = changed(SINE).replace('folder = "recordings"', f'folder = "{folder}/recordings"')
        text = text.replace("[recording]", "[service]\nstall_ms = 2000.0\n[recording]")
        section = parse(text, "paper", folder, "paper").axes[0].controller
        assert section is not None
        with Bench(folder, text=text, board=False) as bench:
            wait_for(lambda: bench.ticks > QUIET_TICKS, "a quiet stretch")
            first = bench.ticks
            controller = section.model_dump(exclude_unset=True)
            ticks = np.array([swap(bench, number, controller) for number in range(given.swaps)])
            assert bench.stop() == 0, bench.log()
            total = account(folder / "recordings", bench.blocks)
            recording = rtloop.load(list((folder / "recordings").glob("*.mcap")))
        demand_v, exec_us = recording.read("x_demand_v", "exec_us")
        steps_v = np.abs(np.diff(demand_v))
        quiet_v, after_v = steps_v[QUIET_TICKS // 3 : first - 1].max(), steps_v[ticks].max()
        others_us = np.delete(exec_us[first : ticks[-1]], ticks[:-1] - first)
        print(
            f"{given.swaps} swaps: largest |Δdemand| {steps_v[ticks - 1].max():.4f} V at a swap, "
            f"{after_v:.4f} V in the tick after it, {quiet_v:.4f} V before"
        )
        for label, values in (("swap", exec_us[ticks]), ("other", others_us)):
            p50, p99 = np.quantile(values, [0.5, 0.99])
            print(f"  exec_us of {label} ticks: p50 {p50:.2f}, p99 {p99:.2f}, max {values.max():.2f}")
        print(f"  ticks {total.executed}, lost {total.lost}; {total.problems or 'replays identical'}")
        assert steps_v[ticks - 1].max() <= 1.1 * quiet_v
        assert total.lost == 0
        assert not total.problems


if __name__ == "__main__":
    main()

"""The driver `udp` behind `tc netem`, a row for each disturbance: `make soak NAME=netem`, as root.

Exit code 0 only if driver and node counted in each row what captures before and behind netem show, no output was ever
wrong, delays were measured within ALLOWED_US, and a cable that was out and in again moved nothing.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from tests.drivers.node_calls import open_calls
from tests.node.node_process import read_witness
from tests.soak.netem.exchange import AGE, DIGITAL, driver_of, node_program, run
from tests.soak.netem.namespaces import Network, network, reason_without

NODE = Path(__file__).resolve().parents[3] / "deploy/node"
ROWS: dict[str, str] = {
    "good": "",
    "loss 1 %": "loss 1%",
    "loss 5 %": "loss 5%",
    "loss in bursts": "loss 5% 50%",
    "delay 300 µs": "delay 300us",
    "delay 3 ms ± 2 ms": "delay 3ms 2ms",
    "reordering 20 %": "delay 5ms reorder 80% 50%",
    "duplication 5 %": "duplicate 5%",
    "corruption 5 %": "corrupt 5%",
    "all": "delay 1ms 1ms loss 2% duplicate 2% corrupt 2%",
}
DELAYS_US = (100, 300, 1000)
ALLOWED_US = 20.0
EXCHANGES = 1000
WATCHDOG_MS = 100.0


def disturb_rows(built: Network, program: Path, folder: Path, rows: list[str], rate_hz: float, ticks: int) -> bool:
    """Print a row for each disturbance; return whether all are as they must be."""
    print(f"{'netem':20} {'drives':>6} {'arrived':>7} {'samples':>7} {'arrived':>7} {'dropped':>9} {'broken':>6} "
          f"{'held':>5} {'stale':>5}  driver: lost late doubled invalid foreign   "
          "node: invalid old   equal  wrong")  # fmt: skip
    good = True
    for name in rows:
        o = run(built, program, folder, ROWS[name].split(), rate_hz, ticks)
        dropped, equal = "+".join(map(str, o.netem)), "yes" if o.is_equal else "NO"
        print(f"{name:20} {o.drives:6} {o.at_node:7} {o.samples:7} {o.at_loop:7} {dropped:>9} {o.broken:6} "
              f"{o.held:5} {o.stale:5}  {o.driver!s:42} {o.node!s:15}  {equal:5}  {o.wrong}", flush=True)  # fmt: skip
        if not o.is_equal:
            print(f"{'':20} by the captures: {o.capture}, {o.node_capture}; stale {o.stale_due}; netem {o.passed}")
        good &= o.is_equal and o.wrong == 0
    return good


def delay_rows(built: Network, program: Path, folder: Path, rate_hz: float) -> bool:
    """Print the median exchange for each delay towards the node; return whether each is within ALLOWED_US."""
    medians = {}
    with node_program(built, program, folder / "witness", "--spin"):
        for delay_us in (0, *DELAYS_US):
            # netem without a delay stands in the way too, so that the delay is the only difference.
            built.disturb_one("wire1", "delay", f"{delay_us}us")
            with built.inside("loop"):
                medians[delay_us] = median(driver_of(rate_hz).measure_exchanges(EXCHANGES).durations_us)
            built.disturb()
    good = True
    for delay_us in DELAYS_US:
        error_us = medians[delay_us] - medians[0] - delay_us
        good &= abs(error_us) <= ALLOWED_US
        print(
            f"delay {delay_us:5} µs: exchange {medians[delay_us]:7.1f} µs, without {medians[0]:6.1f} µs, "
            f"error {error_us:6.1f} µs"
        )
    return good


def cable_row(built: Network, program: Path, folder: Path, rate_hz: float) -> bool:
    """Take the node's cable out for longer than its watchdog, and put it in again; return whether nothing moved."""
    with node_program(built, program, folder / "witness"):
        driver = driver_of(rate_hz, watchdog_ms=WATCHDOG_MS)
        with built.inside("loop"):
            calls = open_calls(driver)
        calls.read()

        def tick_for(duration_s: float) -> list[tuple[int, float]]:
            results, end_s = [], time.monotonic() + duration_s
            while time.monotonic() < end_s:
                calls.write([5.0, *[0.0] * DIGITAL])
                time.sleep(1 / rate_hz)
                status, values = calls.read()
                results.append((status, values[AGE]))
            return results

        before = tick_for(0.2)
        driven = read_witness(folder / "witness").outputs[0].code
        built.run("node", "ip", "link", "set", "node0", "down")
        out = tick_for(1.0)
        reported = sum(status != 0 for status, _ in out)
        parked = read_witness(folder / "witness")
        built.run("node", "ip", "link", "set", "node0", "up")
        built.run("node", "ip", "route", "replace", "default", "via", "10.77.2.1")
        after = tick_for(1.0)
        moved = read_witness(folder / "witness")
        good = [
            all(status == 0 for status, _ in before[5:]), abs(driven - 16384) < 2,
            reported >= len(out) - 2, sum(age == float("inf") for _, age in out) >= len(out) - 6,
            parked.outputs[0].code == 0, parked.watchdog_trips == 1,
            moved.outputs[0].code == 0, moved.writes == parked.writes, after[-1][0] < 0,
        ]  # fmt: skip
        print(f"cable out and in: {reported} of {len(out)} ticks reported it, outputs {driven} → "
              f"{parked.outputs[0].code}, after it {moved.outputs[0].code}, {moved.writes - parked.writes} writes; "
              f"{driver.error}")  # fmt: skip
        driver.close()
    if not all(good):
        print(f"{'':20} {good}")
    return all(good)


def main() -> None:
    """Build the namespaces and the node, and print the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate-hz", type=float, default=1000.0)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each row")
    parser.add_argument("--program", type=Path, help="a compiled rtloop-node; by default it is compiled")
    parser.add_argument("--only", choices=["rows", "delays", "cable"], help="by default all")
    given = parser.parse_args()
    reason = reason_without()
    if reason and given.only != "cable":
        sys.exit(f"netem: skipped: {reason}")
    with tempfile.TemporaryDirectory() as name, network() as built:
        folder, program = Path(name), given.program
        if program is None:
            if not (shutil.which("cc") and shutil.which("make")):
                sys.exit("netem: skipped: the node needs a C compiler and make")
            subprocess.run(["make", "-s", "-C", NODE, "all", f"BUILD={folder}/build"], check=True)
            program = folder / "build" / "rtloop-node"
        good = True
        if given.only in (None, "rows"):
            good &= disturb_rows(
                built, program, folder, list(ROWS), given.rate_hz, round(given.seconds * given.rate_hz)
            )
        if given.only in (None, "delays"):
            good &= delay_rows(built, program, folder, given.rate_hz)
        if given.only in (None, "cable"):
            good &= cable_row(built, program, folder, given.rate_hz)
    print(json.dumps({"good": good}))
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()

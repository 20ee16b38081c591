"""The driver `udp` behind `tc netem`, a row for each disturbance: `make soak NAME=netem`, as root.

The exit code is 0 only if in each row the counts of driver and node equal the counts of captures before and behind
netem, no output was ever wrong, delays were measured within ALLOWED_US, and a replugged cable moved no output.
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
from tests.soak.netem.exchange import AGE, DIGITAL, build_driver, node_program, run
from tests.soak.netem.namespaces import Network, missing_requirement, network

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


def disturb_rows(namespaces: Network, program: Path, folder: Path, rows: list[str], rate_hz: float, ticks: int) -> bool:
    """Print a row for each disturbance; return whether in all rows the counts are equal and no output was wrong."""
    print(f"{'netem':20} {'drives':>6} {'arrived':>7} {'samples':>7} {'arrived':>7} {'dropped':>9} {'broken':>6} "
          f"{'held':>5} {'stale':>5}  driver: lost late doubled invalid foreign   "
          "node: invalid old   equal  wrong")  # fmt: skip
    passed = True
    for name in rows:
        outcome = run(namespaces, program, folder, ROWS[name].split(), rate_hz, ticks)
        dropped, equal = "+".join(map(str, outcome.netem)), "yes" if outcome.is_equal else "NO"
        print(f"{name:20} {outcome.drives:6} {outcome.at_node:7} {outcome.samples:7} {outcome.at_loop:7} "
              f"{dropped:>9} {outcome.broken:6} {outcome.held:5} {outcome.stale:5}  {outcome.driver!s:42} "
              f"{outcome.node!s:15}  {equal:5}  {outcome.wrong}", flush=True)  # fmt: skip
        if not outcome.is_equal:
            print(
                f"{'':20} by the captures: {outcome.capture}, {outcome.node_capture}; "
                f"stale {outcome.stale_due}; netem {outcome.passed}"
            )
        passed &= outcome.is_equal and outcome.wrong == 0
    return passed


def delay_rows(namespaces: Network, program: Path, folder: Path, rate_hz: float) -> bool:
    """Print the median exchange for each delay towards the node; return whether each is within ALLOWED_US."""
    medians = {}
    with node_program(namespaces, program, folder / "witness", "--spin"):
        for delay_us in (0, *DELAYS_US):
            # Without a delay netem is in the path too, so that the delay is the only difference.
            namespaces.disturb_one("wire1", "delay", f"{delay_us}us")
            with namespaces.inside("loop"):
                medians[delay_us] = median(build_driver(rate_hz).measure_exchanges(EXCHANGES).durations_us)
            namespaces.disturb()
    passed = True
    for delay_us in DELAYS_US:
        error_us = medians[delay_us] - medians[0] - delay_us
        passed &= abs(error_us) <= ALLOWED_US
        print(
            f"delay {delay_us:5} µs: exchange {medians[delay_us]:7.1f} µs, without {medians[0]:6.1f} µs, "
            f"error {error_us:6.1f} µs"
        )
    return passed


def cable_row(namespaces: Network, program: Path, folder: Path, rate_hz: float) -> bool:
    """Unplug the node's cable for longer than its watchdog, replug it; return whether the outputs parked and stayed."""
    with node_program(namespaces, program, folder / "witness"):
        driver = build_driver(rate_hz, watchdog_ms=WATCHDOG_MS)
        with namespaces.inside("loop"):
            calls = open_calls(driver)
        calls.read()

        def tick_for(duration_s: float) -> list[tuple[int, float]]:
            """Run ticks for a time; return the status and the age of the sample of each."""
            results, end_s = [], time.monotonic() + duration_s
            while time.monotonic() < end_s:
                calls.write([5.0, *[0.0] * DIGITAL])
                time.sleep(1 / rate_hz)
                status, values = calls.read()
                results.append((status, values[AGE]))
            return results

        plugged = tick_for(0.2)
        driven_code = read_witness(folder / "witness").outputs[0].code
        namespaces.run("node", "ip", "link", "set", "node0", "down")
        unplugged = tick_for(1.0)
        reported_ticks = sum(status != 0 for status, _ in unplugged)
        parked = read_witness(folder / "witness")
        namespaces.run("node", "ip", "link", "set", "node0", "up")
        namespaces.run("node", "ip", "route", "replace", "default", "via", "10.77.2.1")
        after = tick_for(1.0)
        replugged = read_witness(folder / "witness")
        checks = [
            all(status == 0 for status, _ in plugged[5:]), abs(driven_code - 16384) < 2,
            reported_ticks >= len(unplugged) - 2,
            sum(age == float("inf") for _, age in unplugged) >= len(unplugged) - 6,
            parked.outputs[0].code == 0, parked.watchdog_trips == 1,
            replugged.outputs[0].code == 0, replugged.writes == parked.writes, after[-1][0] < 0,
        ]  # fmt: skip
        print(f"cable out and in: {reported_ticks} of {len(unplugged)} ticks reported it, "
              f"outputs {driven_code} → {parked.outputs[0].code}, after it {replugged.outputs[0].code}, "
              f"{replugged.writes - parked.writes} writes; {driver.error}")  # fmt: skip
        driver.close()
    if not all(checks):
        print(f"{'':20} {checks}")
    return all(checks)


def main() -> None:
    """Build the namespaces and the node, and print the rows; exit with 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate-hz", type=float, default=1000.0)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each row")
    parser.add_argument("--program", type=Path, help="a compiled rtloop-node; by default it is compiled")
    parser.add_argument("--only", choices=["rows", "delays", "cable"], help="by default all")
    options = parser.parse_args()
    reason = missing_requirement()
    if reason and options.only != "cable":
        sys.exit(f"netem: skipped: {reason}")
    with tempfile.TemporaryDirectory() as name, network() as namespaces:
        folder, program = Path(name), options.program
        if program is None:
            if not (shutil.which("cc") and shutil.which("make")):
                sys.exit("netem: skipped: the node needs a C compiler and make")
            subprocess.run(["make", "-s", "-C", NODE, "all", f"BUILD={folder}/build"], check=True)
            program = folder / "build" / "rtloop-node"
        passed = True
        if options.only in (None, "rows"):
            passed &= disturb_rows(
                namespaces, program, folder, list(ROWS), options.rate_hz, round(options.seconds * options.rate_hz)
            )
        if options.only in (None, "delays"):
            passed &= delay_rows(namespaces, program, folder, options.rate_hz)
        if options.only in (None, "cable"):
            passed &= cable_row(namespaces, program, folder, options.rate_hz)
    print(json.dumps({"good": passed}))
    sys.exit(0 if passed else 1)


if __name__ == "__main__":
    main()

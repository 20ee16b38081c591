"""A service for an hour: paced, on a simulated board, recorded in many files. `make soak NAME=daemon`.

Effects of the host (missed periods, trips) are printed only; faults of the service (lost ticks, memory growth) fail.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import rtloop
from rtloop.errors import RtloopError
from tests.faults.account import account, runs_in
from tests.faults.bench import Bench
from tests.faults.configuration import ROOT

ROLES = ("service", "rt", "recorder")
MAX_GROWTH = 0.05
"""Allowed growth of memory, as a share."""
SETTLE_S = 20.0


def resident_mib_by_role(bench: Bench) -> dict[str, float]:
    """Return the resident memory (MiB) of each process of the service, and of the board."""
    assert bench.board is not None
    pids = {role: bench.pid(role) for role in ROLES} | {"board": bench.board.pid}
    return {role: _resident_mib(pid) for role, pid in pids.items()}


def _resident_mib(pid: int) -> float:
    """Return the anonymous resident memory (MiB): the shared rings fill slowly, which is no growth."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024


def configuration(folder: Path, rotate_s: float) -> str:
    """Return deploy/board.toml with board and recordings in `folder`."""
    text = (ROOT / "deploy" / "board.toml").read_text(encoding="utf-8")
    text = text.replace("/dev/shm/rtloop-board", f"{folder}/board")
    text = text.replace('folder = "recordings"', f'folder = "{folder}/recordings"\nmin_free_mib = 0.0')
    return text.replace("rotate_s = 3600.0", f"rotate_s = {rotate_s}")


def watch(bench: Bench, seconds: float) -> tuple[dict[str, float], dict[str, float], int]:
    """Watch the service for `seconds` and reset each trip.

    Return the memory (MiB by role) soon after the start and at the end, and the number of resets.
    """
    time.sleep(min(SETTLE_S, seconds / 4))
    before, resets = resident_mib_by_role(bench), 0
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        time.sleep(min(5.0, max(0.0, end_s - time.monotonic())))
        status = bench.status()
        print(f"\r{status.get('state')} {status.get('ticks')} ticks ", end="", flush=True)
        if status.get("state") == "tripped":
            resets += 1
            if status["restarts"] >= len(bench.blocks):
                bench.follow()
            try:
                bench.recover()
            except (RtloopError, AssertionError) as error:
                print(f"\nnot recovered yet: {error}")
    print()
    return before, resident_mib_by_role(bench), resets


def main() -> None:
    """Run and print the figures. Raises AssertionError for a lost tick, memory growth or a replay that differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--rotate-s", type=float, default=600.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Bench(folder, text=configuration(folder, options.rotate_s)) as bench:
            before, after, resets = watch(bench, options.minutes * 60)
            assert bench.stop() == 0, bench.log()
            total = account(folder / "recordings", bench.blocks)
        print(
            f"ticks {total.executed}, lost {total.lost}; files {[len(run) for run in runs_in(folder / 'recordings')]}"
        )
        print(f"periods missed {total.periods_missed}; trips {resets}: {describe_trips(folder)}")
        for role, mib in before.items():
            print(f"  {role:9} {mib:7.1f} MiB at the start, {after[role]:7.1f} MiB at the end")
        print("replay: " + ("; ".join(total.problems) or "identical"))
        assert total.lost == 0
        assert not total.problems
        assert all(after[role] <= before[role] * (1 + MAX_GROWTH) for role in before)


def describe_trips(folder: Path) -> list[str]:
    """Return the tick and causes of each trip, in order."""
    return [
        f"tick {event['tick']}: {', '.join(event['what']['causes'])}"
        for run in runs_in(folder / "recordings")
        for event in rtloop.load(run).events
        if event["kind"] == "tripped"
    ]


if __name__ == "__main__":
    main()

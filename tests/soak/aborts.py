"""Ctrl-C at random moments of experiments: outputs parked, recordings complete. `make soak NAME=aborts`.

In turn all of them in virtual time, where most moments fall between two runs, and one in real time, where they fall
into a drive.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

import rtloop
from rtloop.experiments.registry import EXPERIMENTS
from rtloop.recording.views.summary import summarise

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 280.0
PARKED_V = 1e-6
CONFIG = str(ROOT / "deploy" / "paper.toml")
ALL_S, ONE_S = 40.0, 15.0
"""About as long as all experiments take in virtual time; within one in real time."""


class Aborted(NamedTuple):
    """What an interrupted command left behind."""

    exit_code: int
    error: str
    recordings: list[Path]
    report: bool


def abort(folder: Path, after_s: float, *arguments: str) -> Aborted:
    """Start `rtloop experiment`, interrupt it `after_s` after its first recording began, and wait for its end."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rtloop", "experiment", *arguments, "--out", str(folder)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + TIMEOUT_S
        while not any(folder.glob("*.mcap*")) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(after_s)
        process.send_signal(signal.SIGINT)
        error = process.communicate(timeout=TIMEOUT_S)[1]
    finally:
        process.kill()
        process.wait()
    return Aborted(process.returncode, error, sorted(folder.glob("*.mcap")), (folder / "report.html").exists())


def check(found: Aborted, folder: Path) -> str:
    """Raise AssertionError where something is not as it must be; else a line about it."""
    assert "Traceback" not in found.error, found.error
    assert found.exit_code in (0, 1), found
    too_late_for_a_run = "no report was written" in found.error
    assert found.exit_code == 0 or too_late_for_a_run or "interrupted. The outputs are parked" in found.error, (
        found.error
    )
    assert found.recordings, found.error
    assert found.report or too_late_for_a_run, found.error
    assert not list(folder.glob("*.part")), "a recording was left unfinished"
    for path in found.recordings:
        assert summarise(path).complete, (path, found.error)
    last = found.recordings[int(np.argmax([path.stat().st_mtime for path in found.recordings]))]
    drive = rtloop.load(last)["x_drive_v"]
    summary = summarise(last)
    if summary.ticks_logged < summary.ticks_expected:  # a run that came to its end ramps after its last record
        assert drive.size == 0 or abs(drive[-1]) < PARKED_V, f"{last}: ends at {drive[-1]} V"
    said = ", left out the report" if too_late_for_a_run else ""
    return f"exit {found.exit_code}{said}, {len(found.recordings)} recordings, last {last.name} of {drive.size:,} ticks"


def main() -> None:
    """As many as asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    random = np.random.default_rng(given.seed)
    for number in range(given.count):
        if number % 2:
            arguments, longest_s = ("run", str(random.choice(list(EXPERIMENTS))), CONFIG, "--paced"), ONE_S
        else:
            arguments, longest_s = ("paper", CONFIG), ALL_S
        after_s = float(random.uniform(0.0, longest_s))
        with tempfile.TemporaryDirectory() as name:
            line = check(abort(Path(name), after_s, *arguments), Path(name))
        what = " ".join(argument for argument in arguments if argument != CONFIG)
        print(f"{number + 1}/{given.count}: {what}, after {after_s:.2f} s: {line}", flush=True)


if __name__ == "__main__":
    main()

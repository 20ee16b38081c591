"""Ctrl-C at random moments of experiments parks the outputs and leaves complete recordings. `make soak NAME=aborts`.

Interrupts alternate between all experiments in virtual time, where most fall between two runs, and one experiment in
real time, where most fall into a run that drives the actuator.
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
"""Largest |drive| (V) that counts as parked."""
CONFIG = str(ROOT / "deploy" / "paper.toml")
ALL_S, ONE_S = 40.0, 15.0
"""Latest interrupt (s) after the first recording began: of all experiments in virtual time; of one in real time."""


class InterruptedCommand(NamedTuple):
    """Exit code, stderr and recordings of an interrupted `rtloop experiment`; `report`: whether it wrote a report."""

    exit_code: int
    error: str
    recordings: list[Path]
    report: bool


def abort(folder: Path, after_s: float, *arguments: str) -> InterruptedCommand:
    """Start `rtloop experiment`, send SIGINT `after_s` after its first recording began, and wait for its end."""
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
    return InterruptedCommand(
        process.returncode, error, sorted(folder.glob("*.mcap")), (folder / "report.html").exists()
    )


def check(command: InterruptedCommand, folder: Path) -> str:
    """Check exit code, recordings and parked output. Return a line of text. Raises AssertionError for a fault."""
    assert "Traceback" not in command.error, command.error
    assert command.exit_code in (0, 1), command
    report_omitted = "no report was written" in command.error
    assert command.exit_code == 0 or report_omitted or "interrupted. The outputs are parked" in command.error, (
        command.error
    )
    assert command.recordings, command.error
    assert command.report or report_omitted, command.error
    assert not list(folder.glob("*.part")), "a recording was left unfinished"
    for path in command.recordings:
        assert summarise(path).complete, (path, command.error)
    last_recording = command.recordings[int(np.argmax([path.stat().st_mtime for path in command.recordings]))]
    drive_v = rtloop.load(last_recording)["x_drive_v"]
    summary = summarise(last_recording)
    if summary.ticks_logged < summary.ticks_expected:  # A run that reached its end ramps down after its last record.
        assert drive_v.size == 0 or abs(drive_v[-1]) < PARKED_V, f"{last_recording}: ends at {drive_v[-1]} V"
    report_note = ", left out the report" if report_omitted else ""
    last_text = f"last {last_recording.name} of {drive_v.size:,} ticks"
    return f"exit {command.exit_code}{report_note}, {len(command.recordings)} recordings, {last_text}"


def main() -> None:
    """Interrupt `--count` experiments at random moments and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    random = np.random.default_rng(options.seed)
    for number in range(options.count):
        if number % 2:
            arguments, longest_s = ("run", str(random.choice(list(EXPERIMENTS))), CONFIG, "--paced"), ONE_S
        else:
            arguments, longest_s = ("paper", CONFIG), ALL_S
        after_s = float(random.uniform(0.0, longest_s))
        with tempfile.TemporaryDirectory() as name:
            line = check(abort(Path(name), after_s, *arguments), Path(name))
        experiment = " ".join(argument for argument in arguments if argument != CONFIG)
        print(f"{number + 1}/{options.count}: {experiment}, after {after_s:.2f} s: {line}", flush=True)


if __name__ == "__main__":
    main()

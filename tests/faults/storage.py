"""Faults of the recording: a disk that is full, a ring that is overrun."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rtloop.engine.memory import ProcessState, Word
from tests.faults.bench import Bench
from tests.faults.configuration import BOARD_RATE_HZ
from tests.faults.evidence import wait_for
from tests.faults.fault import Fault, Measured, NotPossible

SMALL = "size=900k"
ROUNDS = 1.4


@contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """A file system of less than a megabyte where the recordings go."""
    recordings = folder / "recordings"
    recordings.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", SMALL, "tmpfs", str(recordings)]
    if os.geteuid() != 0 or subprocess.run(command, check=False, capture_output=True).returncode != 0:
        raise NotPossible("mounting a small file system is not permitted")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(recordings)], check=True)


def disk_full(bench: Bench) -> Measured:
    bench.strike()
    wait_for(
        lambda: int(bench.blocks[-1].words[Word.RECORDER_STATE]) == ProcessState.FAILED,
        "a recorder that cannot write",
        60.0,
    )
    ticks = bench.ticks
    wait_for(lambda: bench.ticks > ticks + 4000, "another second")
    assert bench.status()["state"] == "running"
    return Measured(lost_allowed=True, exit_code=1, note="the loop goes on; said at the end")


def ring_overrun(bench: Bench) -> Measured:
    """Every recorder that comes is stopped at once, until the ring has gone round."""
    words, stopped = bench.blocks[-1].words, set[int]()
    bench.strike()
    until_s = time.monotonic() + ROUNDS * len(bench.blocks[-1]["ticks_slots"]) / BOARD_RATE_HZ
    while time.monotonic() < until_s:
        pid = int(words[Word.RECORDER_PID])
        if pid and pid not in stopped:
            stopped.add(pid)
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGSTOP)
        time.sleep(0.002)
    last = int(words[Word.RECORDER_PID])
    with suppress(ProcessLookupError):
        os.kill(last, signal.SIGCONT)
    wait_for(lambda: int(words[Word.RECORDER_CURSOR]) > bench.ticks - 4000, "a recorder that keeps up")
    assert bench.status()["state"] == "running"
    return Measured(lost_allowed=True, exit_code=1, note=f"{len(stopped)} recorders stopped in a row")


FAULTS = (
    Fault("disk full", "the loop goes on; lost ticks said", disk_full, around=small_disk),
    Fault("ring overrun", "the loop goes on; the gap said", ring_overrun),
)

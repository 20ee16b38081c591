"""A run of the command line whose processes are all killed at once, and its unfinished file."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import NamedTuple

from rtloop.engine.memory import SharedBlock, Word
from rtloop.recording.file.recover import recover
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from tests.service.test_run import PAPER, TIMEOUT_S, children, start


class Killed(NamedTuple):
    """Unfinished file of a killed run, and its numbers of ticks: executed, and taken by the recorder."""

    part: Path
    executed: int
    taken: int


def kill_a_run(folder: Path, after_s: float, *options: str) -> Killed:
    """Run the paper's loop until `after_s` after its file was opened, then kill supervisor, recorder and loop."""
    process = start("run", PAPER, "--out", folder, *options)
    pids = children(process)
    deadline = time.monotonic() + TIMEOUT_S
    while not (parts := list(folder.glob("*.mcap.part"))):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    block = block_of(pids["capture.recorder"])
    time.sleep(after_s)
    for pid in (process.pid, pids["capture.recorder"], pids["engine.process"]):
        os.kill(pid, signal.SIGKILL)
    process.communicate()
    while any(_alive(pid) for pid in pids.values()):
        time.sleep(0.002)
    return Killed(parts[0], int(block["ticks_head"][0]), block.load(Word.RECORDER_CURSOR))


def recovered_ticks(killed: Killed) -> int:
    """Recover the file and replay it. Returns its number of ticks; 0 if it was killed before the first write."""
    report = recover(killed.part)
    assert report["gaps"] == []
    if report["ticks"]:
        verdict = replay(load(report["output"]))
        assert verdict.identical, verdict
        assert verdict.ticks == report["ticks"]
    return report["ticks"]


def block_of(pid: int) -> SharedBlock:
    """Open the shared block of a process, so that it outlives the process."""
    for link in Path(f"/proc/{pid}/fd").iterdir():
        if "memfd:rtloop" in os.readlink(link):
            return SharedBlock(os.open(link, os.O_RDWR))
    raise AssertionError("the recorder has no shared block")


def _alive(pid: int) -> bool:
    """Whether a process runs and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False

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
from tests.service.test_run import PAPER, TIMEOUT_S, process_ids, start


class KilledRun(NamedTuple):
    """A killed run: unfinished file, number of executed ticks, number of ticks taken by the recorder."""

    part: Path
    executed: int
    taken: int


def kill_run(folder: Path, after_s: float, *options: str) -> KilledRun:
    """Run the paper's loop, and kill supervisor, recorder and loop `after_s` after the file was opened."""
    process = start("run", PAPER, "--out", folder, *options)
    pids = process_ids(process)
    deadline = time.monotonic() + TIMEOUT_S
    while not (parts := list(folder.glob("*.mcap.part"))):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    block = open_shared_block(pids["capture.recorder"])
    time.sleep(after_s)
    for pid in (process.pid, pids["capture.recorder"], pids["engine.process"]):
        os.kill(pid, signal.SIGKILL)
    process.communicate()
    while any(_is_alive(pid) for pid in pids.values()):
        time.sleep(0.002)
    return KilledRun(parts[0], int(block["ticks_head"][0]), block.load(Word.RECORDER_CURSOR))


def recovered_ticks(killed: KilledRun) -> int:
    """Recover the file and replay it. Returns its number of ticks; 0 if the run was killed before the first write."""
    report = recover(killed.part)
    assert report["gaps"] == []
    if report["ticks"]:
        verdict = replay(load(report["output"]))
        assert verdict.identical, verdict
        assert verdict.ticks == report["ticks"]
    return report["ticks"]


def open_shared_block(pid: int) -> SharedBlock:
    """Open the shared block of a process, so that the block outlives the process."""
    for link in Path(f"/proc/{pid}/fd").iterdir():
        if "memfd:rtloop" in os.readlink(link):
            return SharedBlock(os.open(link, os.O_RDWR))
    raise AssertionError("the recorder has no shared block")


def _is_alive(pid: int) -> bool:
    """Return whether a process runs and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False

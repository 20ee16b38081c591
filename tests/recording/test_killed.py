"""A killed run leaves its flushed ticks; the next run recovers them, and they replay."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from rtloop.engine.memory import Word
from rtloop.recording.capture.recorder import POLL_S
from rtloop.recording.capture.session import FLUSH_S, UNPACED_CHUNKS
from rtloop.recording.file.topics.format import chunk_rows
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from tests.recording.hand_made_loop import COLUMNS
from tests.recording.killing import kill_run, open_shared_block, recovered_ticks
from tests.service.test_run import PAPER, finish, process_ids, run, start, wait_for_ticks

pytestmark = pytest.mark.system


@pytest.mark.parametrize("after_s", [0.05, 0.5])
def test_a_killed_unpaced_run_lacks_no_more_than_the_chunks_that_wait_for_each_other(after_s: float, tmp_path: Path):
    killed = kill_run(tmp_path, after_s, "--unpaced")
    assert 0 <= killed.taken - recovered_ticks(killed) <= UNPACED_CHUNKS * chunk_rows(COLUMNS)


def test_the_next_run_recovers_the_file_of_a_killed_one(tmp_path: Path):
    killed = kill_run(tmp_path, 1.5)
    broken = tmp_path / "broken.mcap.part"
    broken.write_bytes(b"")
    code, summary, err = run(PAPER, "--duration", "0.5", "--out", tmp_path)
    recovered = killed.part.with_suffix("")
    warning = f"warning: {broken}: not a recording: an empty file"
    messages = (f"{recovered}: ", f"recovered from {killed.part.name}, which is kept", warning)
    assert (code, [message for message in messages if message not in err]) == (0, [])
    assert killed.executed - len(load(recovered)) <= (FLUSH_S + POLL_S) * 10_000
    for path in (recovered, Path(summary["recording"])):
        assert replay(load(path)).identical
    _, _, err = run(PAPER, "--duration", "0.1", "--unpaced", "--out", tmp_path)
    assert "ticks recovered" not in err


def test_a_loop_in_virtual_time_waits_for_its_recorder_at_half_the_ring(tmp_path: Path):
    """The supervisor is stopped as well, so that it does not replace the recorder."""
    process = start("run", PAPER, "--unpaced", "--duration", "600", "--out", tmp_path, "--json")
    recorder = process_ids(process)["capture.recorder"]
    wait_for_ticks(tmp_path)
    block = open_shared_block(recorder)
    for pid in (process.pid, recorder):
        os.kill(pid, signal.SIGSTOP)
    executed = -1
    while executed != (executed := int(block["ticks_head"][0])):
        time.sleep(1.0)
    lead_ticks = executed - block.load(Word.RECORDER_CURSOR)
    for pid in (recorder, process.pid):
        os.kill(pid, signal.SIGCONT)
    process.send_signal(signal.SIGINT)
    code, summary, _ = finish(process)
    assert lead_ticks == block.ring("ticks").marks.size // 2 + 1  # the tick that finds half the ring unread is the last
    assert (code, summary["ticks_lost"]) == (0, 0)

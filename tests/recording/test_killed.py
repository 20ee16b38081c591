"""A killed run leaves its flushed ticks; the next run recovers them, and they replay."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtloop.recording.capture.session import FLUSH_S
from rtloop.recording.file.topics.format import chunk_rows
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from tests.recording.hand_made_loop import COLUMNS
from tests.recording.killing import kill_a_run, recovered_ticks
from tests.service.test_run import PAPER, run

POLL_S = 0.1


@pytest.mark.parametrize("after_s", [0.05, 0.5])
def test_a_killed_unpaced_run_lacks_less_than_a_chunk_and_the_lag(after_s: float, tmp_path: Path):
    killed = kill_a_run(tmp_path, after_s, "--unpaced")
    assert 0 <= killed.taken - recovered_ticks(killed) <= chunk_rows(COLUMNS)


def test_the_next_run_recovers_the_file_of_a_killed_one(tmp_path: Path):
    killed = kill_a_run(tmp_path, 1.5)
    broken = tmp_path / "broken.mcap.part"
    broken.write_bytes(b"")
    code, summary, err = run(PAPER, "--duration", "0.5", "--out", tmp_path)
    recovered = killed.part.with_suffix("")
    warning = f"warning: {broken}: not a recording: an empty file"
    messages = (f"{recovered}: ", f"recovered from {killed.part.name}, which is kept", warning)
    assert (code, [message for message in messages if message not in err]) == (0, [])
    assert killed.executed - len(load(recovered)) <= (FLUSH_S + 2 * POLL_S) * 10_000
    for path in (recovered, Path(summary["recording"])):
        assert replay(load(path)).identical
    _, _, err = run(PAPER, "--duration", "0.1", "--unpaced", "--out", tmp_path)
    assert "ticks recovered" not in err

"""A service completes an unfinished recording of another one as soon as no process writes to the file."""

from __future__ import annotations

import fcntl
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rtloop.foundation import timing
from rtloop.service.service import Service
from tests.paper_configuration import TEXT
from tests.recording.hand_made_loop import make_rows, write_recording

CUT_OFF_BYTES = 2_000
"""Bytes at the end of a recording that are cut off; the index is among them."""


def test_a_part_that_grew_at_the_start_is_completed_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A recorder outlives its service, and dies while the next service runs."""
    config = tmp_path / "lab.toml"
    folder = tmp_path / "recordings"
    folder.mkdir()
    config.write_text(TEXT.replace('folder = "recordings"', f'folder = "{folder}"'))
    complete_file = write_recording(tmp_path / "whole.mcap", make_rows(5_000))
    part = folder / "lab-1.mcap.part"
    part.write_bytes(complete_file.read_bytes()[:-CUT_OFF_BYTES])
    recorder = part.open("rb")
    fcntl.flock(recorder, fcntl.LOCK_EX)
    service = Service(config)
    start_thread, threads = timing.start_thread, list[threading.Thread]()
    was_completed: list[bool] = []

    def run_loop(_: bool) -> Any:
        threads[0].join()
        was_completed.append((folder / "lab-1.mcap").exists())
        recorder.close()
        service.end()
        return SimpleNamespace(exit_code=0, error=None)

    monkeypatch.setattr(timing, "start_thread", lambda work: threads.append(start_thread(work)) or threads[-1])
    monkeypatch.setattr(service, "_run_loop", run_loop)
    assert service.run() == 0
    assert was_completed == [False]
    assert (folder / "lab-1.mcap").exists()

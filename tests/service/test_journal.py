"""Nobody waits for a log: a full pipe costs lines, and neither a tick nor a parking."""

from __future__ import annotations

import logging
import os
import re
import signal
from pathlib import Path

import pytest

from rtloop.service.journal import Journal
from tests.faults.bench import Bench
from tests.full_pipe import fill


@pytest.fixture
def pipe():
    """Reading and writing end of a pipe that is full."""
    reading, writing = os.pipe()
    yield reading, writing, fill(writing)
    os.close(reading)


def record(text: str) -> logging.LogRecord:
    return logging.LogRecord("test", logging.INFO, __file__, 1, text, None, None)


def read(reading: int, size: int) -> bytes:
    data = b""
    while len(data) < size:
        data += os.read(reading, size - len(data))
    return data


def test_a_full_pipe_holds_nobody_up_and_what_was_lost_is_counted(pipe):
    reading, writing, size = pipe
    journal = Journal(writing, lines=3)
    for number in range(10):
        journal.handle(record(f"line {number}"))  # the test would stand still here
    assert read(reading, size) == b"x" * size
    journal.flush()
    found = os.read(reading, 4096).decode()
    written = [int(number) for number in re.findall(r"^line (\d)$", found, re.MULTILINE)]
    lost = [
        int(lines)
        for lines in re.findall(r"^\((\d+) lines of the log are lost here, since stderr", found, re.MULTILINE)
    ]
    assert written == sorted(set(written))
    assert lost
    assert len(written) + sum(lost) == 10


def test_a_reader_that_has_gone_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    journal = Journal(writing)
    journal.emit(record("anybody there?"))
    journal.flush()


def test_what_was_said_last_is_written_before_the_end():
    reading, writing = os.pipe()
    journal = Journal(writing)
    for number in range(100):
        journal.emit(record(f"line {number}"))
    journal.flush()
    assert len(os.read(reading, 1 << 16).splitlines()) == 100
    os.close(reading)


def test_the_log_tells_a_death_once_and_an_end(tmp_path: Path):
    with Bench(tmp_path) as bench:
        os.kill(bench.pid("rt"), signal.SIGKILL)
        bench.await_restart()
        bench.await_state("tripped")
        assert bench.stop() == 0
        lines = [line[24:] for line in bench.log().splitlines() if re.match(r"\d{4}-\d\d-\d\d ", line)]
    death = "the loop's process died (signal 9); rtloop parked the outputs"
    assert lines.count(death) == 1
    assert lines[0] == f"starting lab, which records into {tmp_path / 'recordings'}"
    tail = lines[lines.index(death) - 1 :]
    assert tail == ["running", death, "tripped", "stopping: the outputs ramp to safe", "stopped"]
    assert [line for line in lines if line.endswith((":", ": "))] == []


def test_the_log_tells_a_stop_and_an_end_in_their_order(tmp_path: Path):
    """The end ramps as the stop does, but no state that it passes reads as if the service stayed armed."""
    with Bench(tmp_path) as bench:
        bench.await_drive()
        bench.client.post("/stop")
        bench.await_state("armed")
        bench.client.post("/start")
        bench.await_drive()
        assert bench.stop() == 0
        lines = [line[24:] for line in bench.log().splitlines() if re.match(r"\d{4}-\d\d-\d\d ", line)]
    told = [line for line in lines if line not in ("operator takes the lock", "ramping")]  # A ramp may be too short.
    assert told[-5:] == ["running", "armed", "running", "stopping: the outputs ramp to safe", "stopped"]
    assert lines[-2:] == told[-2:]

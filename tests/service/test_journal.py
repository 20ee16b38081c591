"""The journal never waits for its reader: a full pipe costs lines of the log, and delays neither ticks nor parking."""

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

pytestmark = pytest.mark.system


@pytest.fixture
def pipe():
    """Yield the read end and the write end of a full pipe, and the number of bytes in it."""
    read_end, write_end = os.pipe()
    yield read_end, write_end, fill(write_end)
    os.close(read_end)


def make_record(text: str) -> logging.LogRecord:
    """Return a log record with the message `text`."""
    return logging.LogRecord("test", logging.INFO, __file__, 1, text, None, None)


def read_bytes(read_end: int, size: int) -> bytes:
    """Read exactly `size` bytes from the descriptor `read_end`."""
    data = b""
    while len(data) < size:
        data += os.read(read_end, size - len(data))
    return data


def test_a_full_pipe_holds_nobody_up_and_what_was_lost_is_counted(pipe):
    read_end, write_end, size = pipe
    journal = Journal(write_end, lines=3)
    for number in range(10):
        journal.handle(make_record(f"line {number}"))  # a journal that waits would stop the test here
    assert read_bytes(read_end, size) == b"x" * size
    journal.flush()
    output = os.read(read_end, 4096).decode()
    written = [int(number) for number in re.findall(r"^line (\d)$", output, re.MULTILINE)]
    lost = [
        int(lines)
        for lines in re.findall(r"^\((\d+) lines of the log are lost here, because stderr", output, re.MULTILINE)
    ]
    assert written == sorted(set(written))
    assert lost
    assert len(written) + sum(lost) == 10


def test_a_reader_that_has_gone_is_no_error():
    read_end, write_end = os.pipe()
    os.close(read_end)
    journal = Journal(write_end)
    journal.emit(make_record("anybody there?"))
    journal.flush()


def test_what_was_said_last_is_written_before_the_end():
    read_end, write_end = os.pipe()
    journal = Journal(write_end)
    for number in range(100):
        journal.emit(make_record(f"line {number}"))
    journal.flush()
    assert len(os.read(read_end, 1 << 16).splitlines()) == 100
    os.close(read_end)


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
    """The end of the service ramps down like a stop, but logs no state that suggests an armed service."""
    with Bench(tmp_path) as bench:
        bench.await_drive()
        bench.client.post("/stop")
        bench.await_state("armed")
        bench.client.post("/start")
        bench.await_drive()
        assert bench.stop() == 0
        lines = [line[24:] for line in bench.log().splitlines() if re.match(r"\d{4}-\d\d-\d\d ", line)]
    states = [line for line in lines if line not in ("operator takes the lock", "ramping")]  # A short ramp is absent.
    assert states[-5:] == ["running", "armed", "running", "stopping: the outputs ramp to safe", "stopped"]
    assert lines[-2:] == states[-2:]

"""A recorder that is killed at any instant: the next one goes on where its file really ends."""

from __future__ import annotations

import os
import signal
import warnings
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.engine.memory import SharedBlock, Word
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.file.reader import Snapshot
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.events import RECORDER
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.signals import Mode
from tests.recording.disk import Recorded
from tests.recording.hand_made_loop import HandMadeLoop, make_header, make_rows

TICKS, STEP, SNAPSHOT_TICKS, COMMAND_TICKS = 1_200, 400, 250, 100
ROTATE_S = 0.05
LEAST_INSTANTS = 50


class Found(NamedTuple):
    """What a recording holds, by whatever recorders."""

    ticks: list[float]
    events: list[dict[str, Any]]
    snapshots: list[Snapshot]
    problems: list[str]

    def differences(self, expected: Found) -> list[str]:
        """What differs from another one."""
        return [name for name in self._fields if getattr(self, name) != getattr(expected, name)]


class Run:
    """A loop and its recording, by one recorder after the other."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder, self.loop, self.tick = folder, HandMadeLoop(), 0

    def advance(self) -> bool:
        """Some ticks, with snapshots and commands, until all of them were executed."""
        if self.tick == TICKS:
            return False
        for tick in range(self.tick, self.tick + STEP, COMMAND_TICKS):
            self.loop.command(tick, Mode.FEEDFORWARD)
            self.loop.command(tick, Mode.CLOSED_LOOP)
            self.loop.run(make_rows(COMMAND_TICKS, first=tick), snapshot_every=SNAPSHOT_TICKS)
        self.tick += STEP
        return True

    def session(self) -> Session:
        """Of the next recorder, whose files are numbered after those that are there."""
        files = [path for path in self.folder.iterdir() if path.suffix in (".mcap", ".part")]
        options = Options(min_free_bytes=0, rotate_s=ROTATE_S, sequence=1 + len(files))
        return Session(self.loop.block, self.folder / "run.mcap", make_header(), options)

    def found(self) -> Found:
        """What is recorded, once what a killed recorder left is completed."""
        for part in self.folder.glob("*.part"):
            recover(part)
        recording = load(list(self.folder.glob("*.mcap")))
        events = [event for event in recording.events if event["who"] != RECORDER]
        ticks, snapshots = recording["tick"].tolist(), list(recording.snapshots())
        return Found(ticks, events, snapshots, recording.problems)


def step(session: Session) -> None:
    """Take what is there, and write it."""
    while session.drain():
        session.write_due()
    session._write_all()


class Mortal:
    """A recorder in a process of its own, killed in one of its writes, or before a note or a name."""

    def __init__(self, run: Run, instant: int) -> None:
        self._instant = instant
        self._status: int | None = None
        (orders, self._orders), (self._answers, answers) = os.pipe(), os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            self._pid = os.fork()
        if self._pid == 0:
            try:
                os.close(self._orders)
                self._record(run.session(), orders, answers)
                os._exit(0)
            finally:
                os._exit(1)
        os.close(orders)
        os.close(answers)

    def step(self) -> bool:
        """Have it take and write what is there; whether it lives."""
        with suppress(BrokenPipeError):  # killed before it took any
            os.write(self._orders, b".")
        if os.read(self._answers, 1):
            return True
        self._status = os.waitpid(self._pid, 0)[1]  # nobody takes its place before it is gone, with its locks
        return False

    def end(self) -> bool:
        """Have it finish its file; whether it came to that."""
        os.close(self._orders)
        os.close(self._answers)
        if self._status is None:
            self._status = os.waitpid(self._pid, 0)[1]
        assert self._status in (0, signal.SIGKILL)
        return self._status == 0

    def _record(self, session: Session, orders: int, answers: int) -> None:
        store, pwrite, rename = SharedBlock.store, os.pwrite, os.rename

        def mortal_store(block: SharedBlock, word: Word, value: int) -> None:
            self._live_on()
            store(block, word, value)

        def mortal_pwrite(fd: int, data: bytes, offset: int) -> int:
            half = len(data) // 2
            pwrite(fd, data[:half], offset)
            self._live_on()
            return half + pwrite(fd, data[half:], offset + half)

        def mortal_rename(old: Path, new: Path) -> None:
            self._live_on()
            rename(old, new)

        SharedBlock.store, os.pwrite, os.rename = mortal_store, mortal_pwrite, mortal_rename
        while os.read(orders, 1):
            step(session)
            os.write(answers, b".")
        session.finish("finished")

    def _live_on(self) -> None:
        self._instant -= 1
        if self._instant < 0:
            os.kill(os.getpid(), signal.SIGKILL)


def recorded_by_two(run: Run, instant: int) -> bool:
    """Whether the first one was killed, and another one had to go on."""
    first, second = Mortal(run, instant), None
    while run.advance():
        if second is None and not first.step():
            second = run.session()
        if second is not None:
            step(second)
    if first.end():
        return False
    second = second or run.session()
    step(second)
    second.finish("finished")
    return True


def test_nothing_is_written_twice_or_lost(tmp_path: Path):
    """Ticks, events and snapshots are those of a recorder that lives, at whatever instant one is killed."""
    alone = Run(tmp_path / "alone")
    session = alone.session()
    while alone.advance():
        step(session)
    session.finish("finished")
    expected, wrong = alone.found(), {}
    assert (expected.ticks, expected.problems) == (list(range(TICKS)), [])
    assert (len(expected.events), len(expected.snapshots)) == (2 * TICKS // COMMAND_TICKS, -(-TICKS // SNAPSHOT_TICKS))
    for instant in count():
        run = Run(tmp_path / str(instant))
        if not recorded_by_two(run, instant):
            break
        if differences := run.found().differences(expected):
            wrong[instant] = differences
    assert wrong == {}
    assert instant > LEAST_INSTANTS


def test_what_an_earlier_version_wrote_twice_is_said(tmp_path: Path):
    """A snapshot that stands in two files, where the recorder had died before its note of it."""
    run = Recorded(tmp_path / "run.mcap")
    run.run_to(12_000)
    for _ in "ab":
        run.session._write_all()  # the second time there is nothing to be found behind the announced byte
    block = run.loop.block
    block.store(Word.FLUSHED_SNAPSHOTS, block.load(Word.FLUSHED_SNAPSHOTS) - 1)
    (part,) = tmp_path.iterdir()
    first = tmp_path / "first.mcap"
    first.write_bytes(part.read_bytes())
    run.begin(sequence=2)
    run.run_to(15_000)
    run.end()
    report = replay(load([first, tmp_path / "run-0002.mcap"]))
    assert (report.identical, report.first_difference, report.ticks) == (False, None, 15_000)
    assert "snapshots of the law are out of order: that of tick 10000 comes after 10000" in report.problems

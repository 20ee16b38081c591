"""A recorder that is killed at any instant: the next one goes on where its file really ends."""

from __future__ import annotations

import os
import signal
import warnings
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rtloop.engine.memory import SharedBlock, Word
from rtloop.recording.capture import session
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.cutting.cut import cut
from rtloop.recording.file.reader import Reader, Snapshot
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.events import RECORDER
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from rtloop.signals import Mode
from tests.recording.disk import Recorded
from tests.recording.hand_made_loop import HandMadeLoop, make_header, make_rows

TICKS, STEP, SNAPSHOT_TICKS, COMMAND_TICKS = 1_200, 400, 250, 100
ROTATE_S = 0.05
LEAST_INSTANTS = 50


KILLED, END, SNAPSHOT = 15_722, 22_000, 10_000
"""Ticks: up to which a recorder wrote, the last of the run, the last snapshot before the recorder's death."""


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

    def first_ticks(self) -> list[int]:
        """The first tick of each finished file, by its header."""
        ticks = []
        for path in self.folder.glob("*.mcap"):
            with Reader(path) as reader:
                ticks.append(reader.first_tick)
        return ticks


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
    recorder = alone.session()
    while alone.advance():
        step(recorder)
    recorder.finish("finished")
    expected, wrong = alone.found(), {}
    assert (expected.ticks, expected.problems) == (list(range(TICKS)), [])
    assert (len(expected.events), len(expected.snapshots)) == (2 * TICKS // COMMAND_TICKS, -(-TICKS // SNAPSHOT_TICKS))
    for instant in count():
        run = Run(tmp_path / str(instant))
        if not recorded_by_two(run, instant):
            break
        if differences := run.found().differences(expected):
            wrong[instant] = differences
        if any(tick % SNAPSHOT_TICKS for tick in run.first_ticks()):
            wrong[instant] = ["a file that does not begin at a snapshot"]
    assert wrong == {}
    assert instant > LEAST_INSTANTS


def test_what_an_earlier_version_wrote_twice_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A snapshot that stands in two files, where the recorder had died before its note of it."""
    monkeypatch.setattr(session, "snapshot_before", lambda *_: None)  # as a replacement went on then
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


class Left(NamedTuple):
    """What two recorders of one run left: the unfinished file of the killed one, the next one's, and the whole run."""

    first: Path
    second: Path
    whole: Path

    def recovered(self, folder: Path, cut_bytes: int = 0) -> Path:
        """The first file completed, without so many bytes at its end."""
        part = folder / "first.mcap.part"
        part.write_bytes(self.first.read_bytes()[: -cut_bytes or None])
        return Path(recover(part)["output"])


def left_by_two(folder: Path, *, killed: int = KILLED, missed: int = 100) -> Left:
    """A recorder is killed at a tick, and another one comes `missed` ticks later."""
    run = Recorded(folder / "run.mcap")
    run.run_to(killed)
    run.session._write_all()
    first = folder / "left.mcap.part"
    first.write_bytes((folder / "run.mcap.part").read_bytes())  # without the lock of this process
    run.loop.run(missed)
    run.begin(sequence=2)
    run.run_to(max(END, run.loop.tick + 1))
    run.end()
    return Left(first, folder / "run-0002.mcap", folder / "whole.mcap")


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Left:
    """Of a run whose recorder was killed between two snapshots, with commands behind the first of them."""
    folder = tmp_path_factory.mktemp("replaced")
    run = Recorded(folder / "whole.mcap")
    run.run_to(END)
    run.end()
    return left_by_two(folder)


def found_in(files: list[Path]) -> Found:
    """What files hold together."""
    recording = load(files)
    events = [event for event in recording.events if event["who"] != RECORDER]
    return Found(recording["tick"].tolist(), events, list(recording.snapshots()), recording.problems)


def check_alone(second: Path, snapshot: int) -> None:
    """A replacement's file begins with a snapshot, and replays from there."""
    recording = load(second)
    assert recording["tick"].tolist() == list(range(snapshot, END))
    assert (next(recording.snapshots()).tick, recording.problems) == (snapshot, [])
    report = replay(recording)
    assert (report.identical, report.ticks, report.not_verified) == (True, END - snapshot, [])
    summary = summarise(second)
    assert (summary.ticks_logged, summary.ticks_lost, summary.complete) == (END - snapshot, 0, True)


def test_the_file_of_a_replacement_replays_alone_from_its_first_tick(left: Left):
    """Commands between the snapshot that it begins with and the death of the other recorder are in it."""
    check_alone(left.second, SNAPSHOT)


def test_a_replacement_at_a_snapshot_repeats_that_alone(tmp_path: Path):
    left = left_by_two(tmp_path, killed=2 * SNAPSHOT)
    check_alone(left.second, 2 * SNAPSHOT)
    assert replay(load([left.recovered(tmp_path), left.second])).identical


@pytest.mark.parametrize("recovered", [True, False])
def test_both_files_of_a_replacement_hold_everything_once(left: Left, tmp_path: Path, recovered: bool):
    files = [left.recovered(tmp_path) if recovered else left.first, left.second]
    assert found_in(files)[:3] == found_in([left.whole])[:3]
    report = replay(load(files))
    assert (report.first_difference, report.ticks, report.gaps, report.not_verified) == (None, END, [], [])
    summary = summarise(files)
    assert (summary.ticks_logged, summary.ticks_lost, summary.complete) == (END, 0, recovered)
    assert summary.commands == summarise(left.whole).commands


def test_a_cut_across_a_replacement_holds_everything_once(left: Left, tmp_path: Path):
    output = tmp_path / "cut.mcap"
    cut([left.recovered(tmp_path), left.second], 12_000, 21_000, output)
    found, expected = found_in([output]), found_in([left.whole])
    assert found.ticks == list(range(SNAPSHOT, 21_000))
    assert found.events == [event for event in expected.events if SNAPSHOT <= event["tick"] < 21_000]
    assert found.snapshots == [one for one in expected.snapshots if SNAPSHOT <= one.tick < 21_000]
    assert replay(load(output)).identical


def test_what_is_damaged_before_a_replacement_is_taken_from_its_repetition(left: Left, tmp_path: Path):
    short = left.recovered(tmp_path, cut_bytes=1_000)  # within its last chunk of ticks
    assert SNAPSHOT < len(load(short)) < KILLED
    assert load([short, left.second])["tick"].tolist() == list(range(END))
    assert replay(load([short, left.second])).identical


def test_a_replacement_that_comes_too_late_for_the_snapshot_goes_on_where_the_other_file_ends(tmp_path: Path):
    left = left_by_two(tmp_path, missed=len(HandMadeLoop().block["ticks_slots"]) - 10)
    with Reader(left.second) as reader:
        assert (reader.header["first_tick"], reader.header.get("repeats_before")) == (KILLED, None)
    report = replay(load([left.recovered(tmp_path), left.second]))
    assert (report.identical, report.gaps) == (True, [])
    (unverified,) = replay(load(left.second)).not_verified
    assert (unverified["first_tick"], unverified["count"]) == (KILLED, 2 * SNAPSHOT - KILLED)


def test_recorders_that_die_before_they_have_repeated_everything_leave_each_tick_once(left: Left, tmp_path: Path):
    """Two replacements, of which the first writes less than it repeats."""
    run = Recorded(tmp_path / "run.mcap")
    run.run_to(KILLED)
    run.session._write_all()
    first = tmp_path / "first.mcap.part"
    first.write_bytes((tmp_path / "run.mcap.part").read_bytes())
    run.begin(sequence=2)
    run.session.drain()  # one chunk, a part of what is to be repeated
    run.session._write_all()
    second = tmp_path / "second.mcap.part"
    second.write_bytes((tmp_path / "run-0002.mcap.part").read_bytes())
    run.begin(sequence=3)
    run.run_to(END)
    run.end()
    files = [Path(recover(part)["output"]) for part in (first, second)] + [tmp_path / "run-0003.mcap"]
    assert 0 < len(load(files[1])) < KILLED - SNAPSHOT
    assert found_in(files) == found_in([left.whole])
    assert replay(load(files)).identical
    assert replay(load(files[2])).identical


def test_events_that_the_dead_recorder_wrote_ahead_of_their_ticks_stand_there_once(left: Left, tmp_path: Path):
    run = Recorded(tmp_path / "run.mcap")
    run.loop.run(KILLED)
    run.session.drain()  # one chunk of ticks, and all events
    run.session._write_all()
    first = tmp_path / "first.mcap.part"
    first.write_bytes((tmp_path / "run.mcap.part").read_bytes())
    run.begin(sequence=2)
    run.run_to(END)
    run.end()
    assert found_in([first, tmp_path / "run-0002.mcap"])[:3] == found_in([left.whole])[:3]

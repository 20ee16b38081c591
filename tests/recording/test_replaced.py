"""A recorder that is killed at any instant: its replacement continues where the file really ends."""

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
from rtloop.recording.capture.progress import FLUSHED
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.cutting.cut import cut
from rtloop.recording.file.reader import Snapshot
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.events import RECORDER
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from rtloop.signals import Mode
from tests.recording.hand_made_loop import HandMadeLoop, make_header, make_rows
from tests.recording.real_loop import RecordedRun

TICKS, STEP, SNAPSHOT_TICKS, COMMAND_TICKS = 800, 400, 250, 100
ROTATE_S = 0.05
MIN_INSTANTS = 50
KILLED, END, SNAPSHOT = 15_722, 22_000, 10_000
"""End of the ticks that a recorder wrote before its death, end of the run, last snapshot before the death."""


class Contents(NamedTuple):
    """Contents of a recording, without the events of its recorders."""

    ticks: list[float]
    events: list[dict[str, Any]]
    snapshots: list[Snapshot]
    problems: list[str]

    def differences(self, expected: Contents) -> list[str]:
        """Return the names of the fields that differ from `expected`."""
        return [name for name in self._fields if getattr(self, name) != getattr(expected, name)]


def read_contents(files: list[Path]) -> Contents:
    """Return the contents of the files of a run."""
    recording = load(files)
    events = [event for event in recording.events if event["who"] != RECORDER]
    return Contents(recording["tick"].tolist(), events, list(recording.snapshots()), recording.problems)


class HandMadeRun:
    """A hand-made loop, and its recording by one recorder after another."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder, self.loop, self.tick = folder, HandMadeLoop(), 0

    def advance(self) -> bool:
        """Execute STEP ticks, with snapshots and commands. Returns False once all ticks are executed."""
        if self.tick == TICKS:
            return False
        for tick in range(self.tick, self.tick + STEP, COMMAND_TICKS):
            self.loop.command(tick, Mode.FEEDFORWARD)
            self.loop.command(tick, Mode.CLOSED_LOOP)
            self.loop.run(make_rows(COMMAND_TICKS, first=tick), snapshot_every=SNAPSHOT_TICKS)
        self.tick += STEP
        return True

    def session(self) -> Session:
        """Return the session of the next recorder, which numbers its files after the existing ones."""
        files = [path for path in self.folder.iterdir() if path.suffix in (".mcap", ".part")]
        options = Options(min_free_bytes=0, rotate_s=ROTATE_S, sequence=1 + len(files))
        return Session(self.loop.block, self.folder / "run.mcap", make_header(), options)

    def contents(self) -> Contents:
        """Recover the files that a killed recorder left. Returns the contents of the recording."""
        for part in self.folder.glob("*.part"):
            recover(part)
        return read_contents(list(self.folder.glob("*.mcap")))

    def first_ticks(self) -> list[int]:
        """Return the first tick of each finished file, by its header."""
        return [load(path).extents[0].first_tick for path in self.folder.glob("*.mcap")]


def drain_and_write(session: Session) -> None:
    """Drain the rings of a session and write all data."""
    while session.drain():
        session.write_due()
    session._write_all()


class MortalRecorder:
    """A recorder in a child process that kills itself at instant number `instant`.

    An instant is the middle of a write, or the moment before a word is stored or a file is renamed.
    """

    def __init__(self, run: HandMadeRun, instant: int) -> None:
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
        """Order the recorder to drain and write. Returns whether the recorder is alive afterwards."""
        with suppress(BrokenPipeError):  # The recorder was killed before it read the order.
            os.write(self._orders, b".")
        if os.read(self._answers, 1):
            return True
        self._status = os.waitpid(self._pid, 0)[1]  # Its locks must be gone before it is replaced.
        return False

    def end(self) -> bool:
        """Order the recorder to finish its file. Returns False if it was killed."""
        os.close(self._orders)
        os.close(self._answers)
        if self._status is None:
            self._status = os.waitpid(self._pid, 0)[1]
        assert self._status in (0, signal.SIGKILL)
        return self._status == 0

    def _record(self, session: Session, orders: int, answers: int) -> None:
        """Drain and write at each order until the pipe `orders` is closed, then finish the file."""
        store, pwrite, rename = SharedBlock.store, os.pwrite, os.rename

        def mortal_store(block: SharedBlock, word: Word, value: int) -> None:
            self._count_instant()
            store(block, word, value)

        def mortal_pwrite(fd: int, data: bytes, offset: int) -> int:
            half = len(data) // 2
            pwrite(fd, data[:half], offset)
            self._count_instant()
            return half + pwrite(fd, data[half:], offset + half)

        def mortal_rename(old: Path, new: Path) -> None:
            self._count_instant()
            rename(old, new)

        SharedBlock.store, os.pwrite, os.rename = mortal_store, mortal_pwrite, mortal_rename
        while os.read(orders, 1):
            drain_and_write(session)
            os.write(answers, b".")
        session.finish("finished")

    def _count_instant(self) -> None:
        """Count one instant, and kill this process at its last one."""
        self._instant -= 1
        if self._instant < 0:
            os.kill(os.getpid(), signal.SIGKILL)


def record_with_replacement(run: HandMadeRun, instant: int) -> bool:
    """Record a run whose first recorder is killed at `instant`. Returns False if that recorder ended earlier."""
    first, second = MortalRecorder(run, instant), None
    while run.advance():
        if second is None and not first.step():
            second = run.session()
        if second is not None:
            drain_and_write(second)
    if first.end():
        return False
    second = second or run.session()
    drain_and_write(second)
    second.finish("finished")
    return True


def test_no_data_is_lost_or_written_twice_whenever_a_recorder_is_killed(tmp_path: Path):
    """Ticks, events and snapshots equal the recording of a recorder that is not killed."""
    undisturbed = HandMadeRun(tmp_path / "alone")
    recorder = undisturbed.session()
    while undisturbed.advance():
        drain_and_write(recorder)
    recorder.finish("finished")
    expected, faults = undisturbed.contents(), {}
    assert (expected.ticks, expected.problems) == (list(range(TICKS)), [])
    assert (len(expected.events), len(expected.snapshots)) == (2 * TICKS // COMMAND_TICKS, -(-TICKS // SNAPSHOT_TICKS))
    for instant in count():
        run = HandMadeRun(tmp_path / str(instant))
        if not record_with_replacement(run, instant):
            break
        if differences := run.contents().differences(expected):
            faults[instant] = differences
        if any(tick % SNAPSHOT_TICKS for tick in run.first_ticks()):
            faults[instant] = ["a file that does not begin at a snapshot"]
    assert faults == {}
    assert instant > MIN_INSTANTS


def begin_run(folder: Path, killed: int = KILLED) -> tuple[RecordedRun, Path]:
    """Record a run up to tick `killed`. Returns the run and a copy of its unfinished file."""
    run = RecordedRun(folder / "run.mcap")
    run.run_to(killed)
    run.session._write_all()
    return run, run.copy_part("left.mcap.part")


def test_a_snapshot_in_two_files_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An earlier version wrote a snapshot twice, if its recorder died before it stored its progress."""
    monkeypatch.setattr(session, "snapshot_before", lambda *_: None)  # A replacement of that version began there.
    run, _ = begin_run(tmp_path, 12_000)
    run.session._write_all()  # This time there is no data behind the announced byte.
    block = run.loop.block
    block.store(Word.FLUSHED_SNAPSHOTS, block.load(Word.FLUSHED_SNAPSHOTS) - 1)
    first = run.copy_part("first.mcap")
    run.begin(sequence=2)
    run.end(15_000)
    report = replay(load([first, tmp_path / "run-0002.mcap"]))
    assert (report.identical, report.first_difference, report.ticks) == (False, None, 15_000)
    assert "snapshots of the law are out of order: tick 10000 after tick 10000" in report.problems


class RunFiles(NamedTuple):
    """Files of one run: unfinished by a killed recorder, written by its replacement, and of a run without a kill."""

    first: Path
    second: Path
    complete: Path

    def recovered(self, folder: Path, cut_bytes: int = 0) -> Path:
        """Recover a copy of the first file without its last `cut_bytes` bytes. Returns the path."""
        part = folder / "first.mcap.part"
        part.write_bytes(self.first.read_bytes()[: -cut_bytes or None])
        return Path(recover(part)["output"])


def record_two_files(folder: Path, *, killed: int = KILLED, missed: int = 100) -> RunFiles:
    """Record a run whose recorder dies at tick `killed` and is replaced `missed` ticks later. Returns the files."""
    run, first = begin_run(folder, killed)
    run.loop.run(missed)
    run.begin(sequence=2)
    run.end(max(END, run.loop.tick + 1))
    return RunFiles(first, folder / "run-0002.mcap", folder / "whole.mcap")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> RunFiles:
    """A run whose recorder was killed between two snapshots, after commands that follow the first of them."""
    folder = tmp_path_factory.mktemp("replaced")
    RecordedRun(folder / "whole.mcap").end(END)
    return record_two_files(folder)


def require_second_file(second: Path, snapshot: int) -> None:
    """Require that a replacement's file begins with a snapshot and replays from there."""
    recording, summary = load(second), summarise(second)
    assert recording["tick"].tolist() == list(range(snapshot, END))
    assert (next(recording.snapshots()).tick, recording.problems) == (snapshot, [])
    report = replay(recording)
    assert (report.identical, report.ticks, report.not_verified) == (True, END - snapshot, [])
    assert (summary.ticks_logged, summary.ticks_lost, summary.complete) == (END - snapshot, 0, True)


def test_the_file_of_a_replacement_replays_alone_from_its_first_tick(files: RunFiles):
    """The file holds the commands between its first snapshot and the death of the first recorder."""
    require_second_file(files.second, SNAPSHOT)


def test_a_replacement_at_a_snapshot_repeats_only_the_snapshot(tmp_path: Path):
    files = record_two_files(tmp_path, killed=2 * SNAPSHOT)
    require_second_file(files.second, 2 * SNAPSHOT)
    assert replay(load([files.recovered(tmp_path), files.second])).identical


@pytest.mark.parametrize("recovered", [True, False])
def test_both_files_of_a_replaced_recorder_hold_all_data_once(files: RunFiles, tmp_path: Path, recovered: bool):
    paths = [files.recovered(tmp_path) if recovered else files.first, files.second]
    assert read_contents(paths)[:3] == read_contents([files.complete])[:3]
    report, summary = replay(load(paths)), summarise(paths)
    assert (report.first_difference, report.ticks, report.gaps, report.not_verified) == (None, END, [], [])
    assert (summary.ticks_logged, summary.ticks_lost, summary.complete) == (END, 0, recovered)
    assert summary.commands == summarise(files.complete).commands


def test_a_cut_across_a_replacement_holds_all_data_once(files: RunFiles, tmp_path: Path):
    output = tmp_path / "cut.mcap"
    cut([files.recovered(tmp_path), files.second], 12_000, 21_000, output)
    copied, expected = read_contents([output]), read_contents([files.complete])
    assert copied.ticks == list(range(SNAPSHOT, 21_000))
    assert copied.events == [event for event in expected.events if SNAPSHOT <= event["tick"] < 21_000]
    assert copied.snapshots == [snapshot for snapshot in expected.snapshots if SNAPSHOT <= snapshot.tick < 21_000]
    assert replay(load(output)).identical


def test_ticks_that_are_damaged_in_the_first_file_are_read_from_the_replacement(files: RunFiles, tmp_path: Path):
    short = files.recovered(tmp_path, cut_bytes=1_000)  # The cut is within its last chunk of ticks.
    recording = load([short, files.second])
    assert SNAPSHOT < len(load(short)) < KILLED
    assert (recording["tick"].tolist(), replay(recording).identical) == (list(range(END)), True)


def test_a_replacement_that_is_too_late_for_the_snapshot_continues_at_the_end_of_the_other_file(tmp_path: Path):
    files = record_two_files(tmp_path, missed=len(HandMadeLoop().block["ticks_slots"]) - 10)
    second = load(files.second)
    assert (second.header["first_tick"], second.header.get("repeats_before")) == (KILLED, None)
    report = replay(load([files.recovered(tmp_path), files.second]))
    assert (report.identical, report.gaps) == (True, [])
    (unverified,) = replay(second).not_verified
    assert (unverified["first_tick"], unverified["count"]) == (KILLED, 2 * SNAPSHOT - KILLED)


def test_ticks_lost_in_the_last_write_of_a_dead_recorder_count_as_lost(tmp_path: Path):
    """The recorder dies after the write, and before it stores that the write is done."""
    run, _ = begin_run(tmp_path)
    words = {word: run.loop.block.load(word) for word in FLUSHED}
    run.loop.run(len(HandMadeLoop().block["ticks_slots"]) + 123)
    run.drain()
    run.session._write_all()
    for word, value in words.items():
        run.loop.block.store(word, value)
    run.begin(sequence=2)
    assert run.end(run.loop.tick + 100)["ticks_lost"] == 123


def test_replacements_that_die_before_they_repeated_all_ticks_leave_each_tick_once(files: RunFiles, tmp_path: Path):
    """The first of two replacements writes less than it repeats."""
    run, first = begin_run(tmp_path)
    run.begin(sequence=2)
    run.session.drain()  # One chunk, a part of the repetition.
    run.session._write_all()
    second = run.copy_part("second.mcap.part", "run-0002.mcap.part")
    run.begin(sequence=3)
    run.end(END)
    paths = [Path(recover(part)["output"]) for part in (first, second)] + [tmp_path / "run-0003.mcap"]
    assert 0 < len(load(paths[1])) < KILLED - SNAPSHOT
    assert read_contents(paths) == read_contents([files.complete])
    assert [replay(load(part)).identical for part in (paths, paths[2])] == [True, True]


def test_events_that_a_dead_recorder_wrote_before_their_ticks_are_recorded_once(files: RunFiles, tmp_path: Path):
    run = RecordedRun(tmp_path / "run.mcap")
    run.loop.run(KILLED)
    run.session.drain()  # One chunk of ticks, and all events.
    run.session._write_all()
    first = run.copy_part("first.mcap.part")
    run.begin(sequence=2)
    run.end(END)
    assert read_contents([first, tmp_path / "run-0002.mcap"])[:3] == read_contents([files.complete])[:3]

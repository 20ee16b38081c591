"""The recorder's process: what it writes is what the rings held, and whatever it lost it says."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rtloop.engine.memory import ProcessState, Word
from rtloop.engine.messages import MESSAGE, Kind, Origin
from rtloop.recording.capture import recorder as module
from rtloop.recording.capture.recorder import Recorder
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.events import message_from_event
from rtloop.recording.load import load
from rtloop.signals import Mode
from tests.recording.hand_made_loop import (
    AXES,
    RATE_HZ,
    START_UNIX_NS,
    HandMadeLoop,
    RecorderProcess,
    make_header,
    make_rows,
    snapshot,
)

SLACK = 20_000


def rows_of(path: Path) -> np.ndarray:
    with Reader(path, tolerant=True) as reader:
        return np.concatenate([*reader.blocks(), np.empty((0, len(reader.columns)))])


def test_records_everything_in_order(loop: HandMadeLoop, recorder: RecorderProcess, tmp_path: Path):
    rows = make_rows(25_000, paced=False)
    recorder.start(tmp_path / "run.mcap", make_header(paced=False, ticks_expected=len(rows)))
    loop.command(0, Mode.CLOSED_LOOP)
    loop.run(rows, slack=SLACK)
    loop.trip(24_000)
    loop.end()
    code, totals = recorder.result()
    assert (code, totals["complete"], totals["error"]) == (0, True, None)
    assert (totals["ticks_logged"], totals["ticks_lost"], totals["events_lost"]) == (len(rows), 0, 0)
    assert rows_of(tmp_path / "run.mcap").tobytes() == rows.tobytes()
    with Reader(tmp_path / "run.mcap") as reader:
        assert reader.problems == []
        assert reader.start_unix_ns == 0  # virtual time
        assert [event["kind"] for event in reader.events] == ["set_mode", "tripped", "finished"]
        assert [s.data for s in reader.snapshots()] == [snapshot(k).tobytes() for k in (0, 10_000, 20_000)]
    assert os.listdir(tmp_path) == ["run.mcap"]
    assert loop.block.load(Word.RECORDER_STATE) == ProcessState.FINISHED
    assert loop.cursor == len(rows)


def test_events_keep_their_values_and_say_what_they_mean(loop, recorder, tmp_path):
    recorder.start(tmp_path / "run.mcap")
    record = np.zeros(1, MESSAGE)
    record["tick"], record["kind"], record["origin"], record["identity"] = 12, Kind.DRIVER_FAILED, Origin.OPERATOR, 7
    record["values"][0, :4] = [np.nan, -0.0, np.inf, 5e-324]
    loop.command(3, Mode.FEEDFORWARD)
    loop.put("events", record[0])
    loop.run(make_rows(20))
    loop.trip(15)
    loop.end()
    recorder.result()
    mode, failure, trip, _ = load(tmp_path / "run.mcap").events
    assert (mode["kind"], mode["who"], mode["what"]["mode"]) == ("set_mode", "schedule", "feedforward")
    assert (trip["axis"], trip["what"]["causes"], trip["time_ns"]) == ("x", ["position", "stale"], 1_500_000)
    assert message_from_event(failure, AXES).tobytes() == record.tobytes()


def test_snapshots_and_commands_stand_in_front_of_the_ticks_they_precede(loop, recorder, tmp_path):
    recorder.start(tmp_path / "run.mcap", make_header(paced=False))
    loop.run(make_rows(30_000), slack=SLACK, snapshot_every=3_000)
    loop.end()
    recorder.result()
    snapshots, last_tick = [], -1
    with Reader(tmp_path / "run.mcap") as reader:
        for rows, messages in reader.chunks():
            if rows is None:
                snapshots += [int.from_bytes(m.payload[32:40], "little") for m in messages if m.channel == 3]
            else:
                last_tick = rows[-1, 0]
            assert all(tick in snapshots for tick in range(0, int(last_tick) + 1, 3_000))


def test_times_are_those_of_the_run(loop, recorder, tmp_path):
    recorder.start(tmp_path / "run.mcap")
    loop.run(make_rows(100))
    loop.end()
    recorder.result()
    with Reader(tmp_path / "run.mcap") as reader:
        assert reader.start_unix_ns == START_UNIX_NS


def test_a_lapped_recorder_counts_what_it_lost(loop, recorder, tmp_path):
    capacity = len(loop.block["ticks_slots"])
    rows = make_rows(capacity + 5_000)
    loop.run(rows)  # before the recorder was told to begin: the first ticks are overwritten
    recorder.start(tmp_path / "run.mcap")
    loop.end()
    code, totals = recorder.result()
    assert code == 0
    assert not totals["complete"]
    assert totals["ticks_lost"] == len(rows) - totals["ticks_logged"] >= 5_000
    logged = rows_of(tmp_path / "run.mcap")
    assert logged.tobytes() == rows[totals["ticks_lost"] :].tobytes()
    gaps = [event["what"] for event in load(tmp_path / "run.mcap").events if event["kind"] == "gap"]
    assert gaps == [{"first_tick": 0, "count": totals["ticks_lost"]}]


def test_is_not_stopped_by_signals_and_ends_with_the_loop(loop, recorder, tmp_path):
    recorder.start(tmp_path / "run.mcap")
    loop.run(make_rows(100))
    recorder.process.send_signal(signal.SIGINT)
    recorder.process.send_signal(signal.SIGTERM)
    recorder.wait_until(lambda: loop.cursor == 100)
    loop.run(make_rows(100, first=100))
    loop.end(ProcessState.FAILED)
    code, totals = recorder.result()
    assert (code, totals["ticks_logged"], totals["complete"]) == (0, 200, False)
    assert load(tmp_path / "run.mcap").events[-1]["what"]["result"] == "failed"


def test_what_was_removed_meanwhile_is_in_the_recording(loop, recorder, tmp_path):
    """Lines may come in pieces, and several at once."""
    recorder.start(tmp_path / "run.mcap")
    loop.run(make_rows(100))
    recorder.wait_until(lambda: loop.cursor == 100)
    gone = [{"file": f"old-{i}.mcap", "size_bytes": 7, "reason": "they may take 1 GiB"} for i in range(3)]
    lines = "".join(json.dumps({"removed": one}) + "\n" for one in gone).encode()
    for part in (lines[:30], lines[30:]):
        recorder.process.stdin.write(part)
        recorder.process.stdin.flush()
    loop.end()
    code, totals = recorder.result()
    assert (code, totals["complete"], totals["events_lost"]) == (0, True, 0)
    found = [event for event in load(tmp_path / "run.mcap").events if event["kind"] == "removed"]
    assert [event["what"] for event in found] == gone
    assert {(event["who"], event["tick"]) for event in found} == {("recorder", 100)}


def test_ends_by_itself_when_everybody_else_is_gone(loop, recorder, tmp_path):
    recorder.start(tmp_path / "run.mcap")
    loop.run(make_rows(100))
    recorder.wait_until(lambda: loop.cursor == 100)
    recorder.process.stdin.close()
    recorder.process.stdin = None
    code, totals = recorder.result()
    assert (code, totals["ticks_logged"], totals["complete"]) == (0, 100, False)
    assert load(tmp_path / "run.mcap").events[-1]["what"]["result"] == "abandoned"


def test_never_overwrites(loop, recorder, tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"precious")
    recorder.start(tmp_path / "run.mcap")
    code, totals = recorder.result()
    assert code == 1
    assert "exists already" in totals["error"]
    assert (tmp_path / "run.mcap").read_bytes() == b"precious"


def test_says_when_it_is_given_nothing_to_write(loop, recorder):
    recorder.process.stdin.close()
    recorder.process.stdin = None
    code, totals = recorder.result()
    assert (code, totals["complete"]) == (1, False)


def test_a_killed_recorder_loses_at_most_what_it_had_not_flushed(loop, recorder, tmp_path):
    recorder.start(tmp_path / "run.mcap", make_header(paced=False))
    rows = make_rows(30_000)
    loop.run(rows, slack=SLACK)
    part = tmp_path / "run.mcap.part"
    recorder.wait_until(lambda: loop.cursor == len(rows))
    recorder.process.kill()
    recorder.process.communicate()
    report = recover(part)
    assert not report["complete"]
    assert report["gaps"] == []
    assert report["ticks"] >= len(rows) - 4_700  # less than one chunk
    assert rows_of(tmp_path / "run.mcap").tobytes() == rows[: report["ticks"]].tobytes()
    assert part.exists()


def test_a_file_that_grows_is_not_recovered(loop, recorder, tmp_path):
    recorder.start(tmp_path / "run.mcap")
    part = tmp_path / "run.mcap.part"
    recorder.wait_until(part.exists)
    with pytest.raises(Exception, match="being written"):
        recover(part)
    loop.end()
    recorder.result()


def _check_full_disk(loop: HandMadeLoop, recorder: RecorderProcess, path: Path) -> None:
    rows = make_rows(80_000)
    recorder.start(path, make_header(paced=False))
    loop.run(rows, slack=SLACK)
    loop.end()
    code, totals = recorder.result()
    assert code == 1
    assert not totals["complete"]
    assert "No space left" in totals["error"] or "File too large" in totals["error"]
    assert loop.cursor == len(rows)  # it went on draining
    logged = rows_of(path)
    assert 0 < len(logged) == totals["ticks_logged"] == len(rows) - totals["ticks_lost"]
    assert logged.tobytes() == rows[: len(logged)].tobytes()
    with Reader(path) as reader:
        assert reader.problems == []  # finished properly, with its index
        assert reader.totals["ticks_lost"] == totals["ticks_lost"]
        assert reader.totals["error"] == totals["error"]


def test_a_file_size_limit(loop, tmp_path):
    recorder = RecorderProcess(loop)
    resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))
    _check_full_disk(loop, recorder, tmp_path / "run.mcap")


def test_a_full_disk(loop, recorder, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "none", disk], capture_output=True).returncode:
        pytest.skip("mounting a small disk is not permitted here")
    try:
        _check_full_disk(loop, recorder, disk / "run.mcap")
    finally:
        subprocess.run(["umount", disk], check=True)


def test_keeps_space_free(loop, recorder, tmp_path):
    status = os.statvfs(tmp_path)
    more_than_there_is = status.f_bavail * status.f_frsize * 2
    recorder.start(tmp_path / "run.mcap", min_free_bytes=more_than_there_is)
    code, totals = recorder.result()
    assert code == 1
    assert "to stay free" in totals["error"]
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("rule", [{"rotate_s": 1.0}, {"rotate_bytes": 1_000_000}])
def test_rotates_at_a_snapshot_without_losing_anything(loop, recorder, tmp_path, rule):
    rows = make_rows(50_000)
    recorder.start(tmp_path / "run.mcap", make_header(paced=False), **rule)
    loop.command(0, Mode.CLOSED_LOOP)
    loop.run(rows, slack=SLACK, snapshot_every=4_000)
    loop.end()
    code, totals = recorder.result()
    assert (code, totals["complete"], totals["ticks_logged"]) == (0, True, len(rows))
    assert len(totals["paths"]) > 2
    for number, path in enumerate(totals["paths"], start=1):
        assert path.endswith(f"run-{number:04d}.mcap")
        with Reader(path) as reader:
            first = next(reader.blocks())[0, 0]
            assert first == reader.header["first_tick"] == next(reader.snapshots()).tick
            assert reader.totals["complete"]
            assert reader.totals["ticks_lost"] == 0
    whole = load(tmp_path / "run-*.mcap")
    assert np.concatenate(list(whole.blocks())).tobytes() == rows.tobytes()
    assert whole.problems == []
    os.remove(totals["paths"][1])
    assert load(tmp_path / "run-*.mcap").problems == ["part 2 of the run is missing"]


def test_event_times_follow_the_deadlines_when_periods_were_missed(loop, recorder, tmp_path):
    rows = make_rows(100)
    rows[50:, 1] += 7e5
    recorder.start(tmp_path / "run.mcap")
    loop.run(rows)
    recorder.wait_until(lambda: loop.cursor == 100)
    loop.trip(60)
    loop.trip(110)
    loop.end()
    recorder.result()
    times = [event["time_ns"] for event in load(tmp_path / "run.mcap").events]
    assert times[:2] == [60 * 100_000 + 700_000, 110 * 100_000 + 700_000]
    assert RATE_HZ == 1e9 / 100_000


POLLS = 100
"""Far fewer than any time limit of the recorder takes, where the clock stands still."""


class EndOfOrders:
    """Orders of a service that is gone."""

    is_closed = True

    def next(self) -> None:
        """No order."""


class EmptyRings:
    """A session whose rings hold nothing; raises StillPolling once it was asked POLLS times."""

    free_rows, cursor, failure = 1, 0, None

    def __init__(self) -> None:
        self.polls = 0

    def drain(self) -> int:
        self.polls += 1
        if self.polls > POLLS:
            raise StillPolling
        return 0

    def write_due(self) -> None:
        """Nothing is due."""


class StillPolling(Exception):
    """The recorder goes on."""


@pytest.fixture
def no_time_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The recorder's clock stands still, and its pauses last no time."""
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: 1_000.0, sleep=lambda _: None))


@pytest.mark.usefixtures("no_time_passes")
def test_a_recorder_without_service_and_loop_ends_at_once(loop):
    assert Recorder(loop.block).record(EmptyRings(), EndOfOrders(), 0.1) == "abandoned"


@pytest.mark.usefixtures("no_time_passes")
def test_a_recorder_without_service_goes_on_while_a_loop_lives(loop):
    """What the loop still does on its way to safe outputs is recorded too."""
    (told, tell), (asked, ask) = os.pipe(), os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        pid = os.fork()
    if pid == 0:
        try:
            loop.block.claim()
            os.write(tell, b".")
            os.close(ask)
            os.read(asked, 1)
        finally:
            os._exit(0)
    os.read(told, 1)
    recorder = Recorder(loop.block)
    with pytest.raises(StillPolling):
        recorder.record(EmptyRings(), EndOfOrders(), 0.1)
    os.close(ask)
    os.waitpid(pid, 0)
    assert recorder.record(EmptyRings(), EndOfOrders(), 0.1) == "abandoned"
    for end in (told, tell, asked):
        os.close(end)

"""The recorder process: it writes the contents of the rings and reports every loss."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest

from rtloop.engine.memory import ProcessState, Word
from rtloop.engine.messages import MESSAGE, Kind, Origin
from rtloop.foundation import timing
from rtloop.recording.capture.recorder import Recorder
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.events import message_from_event
from rtloop.recording.load import load
from rtloop.signals import Mode
from tests.recording.hand_made_loop import (
    AXES,
    RATE_HZ,
    SLACK,
    START_UNIX_NS,
    HandMadeLoop,
    RecorderProcess,
    make_header,
    make_rows,
    snapshot,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def read_rows(path: Path) -> np.ndarray:
    """Return all readable rows (ticks, columns) of a file."""
    with Reader(path, tolerant=True) as reader:
        return np.concatenate([*reader.blocks(), np.empty((0, len(reader.columns)))])


def stored_result(path: Path) -> str:
    """Return the result that the recording's final event holds."""
    return load(path).events[-1]["what"]["result"]


def test_all_ticks_events_and_snapshots_are_recorded_in_order(
    loop: HandMadeLoop, recorder: RecorderProcess, path: Path
):
    rows = make_rows(25_000, paced=False)
    recorder.start(path, make_header(paced=False, ticks_expected=len(rows)))
    loop.command(0, Mode.CLOSED_LOOP)
    loop.run(rows, slack=SLACK)
    loop.trip(24_000)
    code, totals = recorder.end()
    assert (code, totals["complete"], totals["error"]) == (0, True, None)
    assert (totals["ticks_logged"], totals["ticks_lost"], totals["events_lost"]) == (len(rows), 0, 0)
    assert read_rows(path).tobytes() == rows.tobytes()
    with Reader(path) as reader:
        assert (reader.problems, reader.start_unix_ns) == ([], 0)  # Virtual time begins at 0.
        assert [event["kind"] for event in reader.events] == ["set_mode", "tripped", "finished"]
        assert [s.data for s in reader.snapshots()] == [snapshot(k).tobytes() for k in (0, 10_000, 20_000)]
    assert os.listdir(path.parent) == ["run.mcap"]
    assert (loop.block.load(Word.RECORDER_STATE), loop.cursor) == (ProcessState.FINISHED, len(rows))


def test_events_keep_their_values_and_gain_their_meaning(loop, recorder, path):
    recorder.start(path)
    record = np.zeros(1, MESSAGE)
    record["tick"], record["kind"], record["origin"], record["identity"] = 12, Kind.DRIVER_FAILED, Origin.OPERATOR, 7
    record["values"][0, :4] = [np.nan, -0.0, np.inf, 5e-324]
    loop.command(3, Mode.FEEDFORWARD)
    loop.put("events", record[0])
    loop.run(make_rows(20))
    loop.trip(15)
    recorder.end()
    mode, failure, trip, _ = load(path).events
    assert (mode["kind"], mode["who"], mode["what"]["mode"]) == ("set_mode", "schedule", "feedforward")
    assert (trip["axis"], trip["what"]["causes"], trip["time_ns"]) == ("x", ["position", "stale"], 1_500_000)
    assert message_from_event(failure, AXES).tobytes() == record.tobytes()
    with Reader(path) as reader:
        assert reader.start_unix_ns == START_UNIX_NS


def test_snapshots_precede_their_ticks(loop, recorder, path):
    recorder.start(path, make_header(paced=False))
    loop.run(make_rows(30_000), slack=SLACK, snapshot_every=3_000)
    recorder.end()
    snapshots, last_tick = [], -1
    with Reader(path) as reader:
        for rows, messages in reader.chunks():
            snapshots += [int.from_bytes(m.payload[32:40], "little") for m in messages if m.channel == 3]
            last_tick = last_tick if rows is None else rows[-1, 0]
            assert all(tick in snapshots for tick in range(0, int(last_tick) + 1, 3_000))


def test_a_lapped_recorder_counts_lost_ticks(loop, recorder, path):
    rows = make_rows(len(loop.block["ticks_slots"]) + 5_000)
    loop.run(rows)  # The recorder has no order yet: the first ticks are overwritten.
    recorder.start(path)
    code, totals = recorder.end()
    lost = totals["ticks_lost"]
    assert (code, totals["complete"]) == (0, False)
    assert lost == len(rows) - totals["ticks_logged"] >= 5_000
    assert read_rows(path).tobytes() == rows[lost:].tobytes()
    gaps = [event["what"] for event in load(path).events if event["kind"] == "gap"]
    assert gaps == [{"first_tick": 0, "count": lost}]


def test_signals_do_not_stop_the_recorder_and_it_ends_with_the_loop(loop, recorder, path):
    recorder.start(path)
    loop.run(make_rows(100))
    for number in (signal.SIGINT, signal.SIGTERM):
        recorder.process.send_signal(number)
    recorder.wait_for_ticks(100)
    loop.run(make_rows(100, first=100))
    code, totals = recorder.end(ProcessState.FAILED)
    assert (code, totals["ticks_logged"], totals["complete"], stored_result(path)) == (0, 200, False, "failed")


def test_removed_files_are_recorded(loop, recorder, path):
    """Lines may arrive in pieces, and several at once."""
    recorder.start(path)
    loop.run(make_rows(100))
    recorder.wait_for_ticks(100)
    removals = [{"file": f"old-{i}.mcap", "size_bytes": 7, "reason": "they may take 1 GiB"} for i in range(3)]
    lines = "".join(json.dumps({"removed": removal}) + "\n" for removal in removals).encode()
    for part in (lines[:30], lines[30:]):
        recorder.process.stdin.write(part)
        recorder.process.stdin.flush()
    code, totals = recorder.end()
    assert (code, totals["complete"], totals["events_lost"]) == (0, True, 0)
    events = [event for event in load(path).events if event["kind"] == "removed"]
    assert [event["what"] for event in events] == removals
    assert {(event["who"], event["tick"]) for event in events} == {("recorder", 100)}


def test_the_recorder_ends_when_service_and_loop_are_gone(loop, recorder, path):
    recorder.start(path)
    loop.run(make_rows(100))
    recorder.wait_for_ticks(100)
    recorder.close_orders()
    code, totals = recorder.result()
    assert (code, totals["ticks_logged"], totals["complete"], stored_result(path)) == (0, 100, False, "abandoned")


def test_a_file_is_never_overwritten(recorder, path):
    path.write_bytes(b"precious")
    recorder.start(path)
    code, totals = recorder.result()
    assert (code, "exists already" in totals["error"], path.read_bytes()) == (1, True, b"precious")


def test_a_recorder_without_an_order_is_not_complete(recorder):
    recorder.close_orders()
    code, totals = recorder.result()
    assert (code, totals["complete"]) == (1, False)


def test_a_killed_recorder_in_virtual_time_loses_no_more_than_the_chunks_that_wait(loop, recorder, path):
    rows, part = make_rows(60_000), path.with_name("run.mcap.part")
    recorder.start(path, make_header(paced=False))
    loop.run(rows, slack=SLACK)
    recorder.wait_for_ticks(len(rows))
    recorder.process.kill()
    recorder.process.communicate()
    report = recover(part)
    assert (report["complete"], report["gaps"], part.exists()) == (False, [], True)
    assert report["ticks"] >= len(rows) - 8 * 4_700 > 20_000
    assert read_rows(path).tobytes() == rows[: report["ticks"]].tobytes()


def test_a_growing_file_is_not_recovered(recorder, path):
    recorder.start(path)
    part = path.with_name("run.mcap.part")
    recorder.wait_until(part.exists)
    with pytest.raises(Exception, match="a recorder is writing this file"):
        recover(part)
    recorder.end()


def check_full_disk(recorder: RecorderProcess, path: Path) -> None:
    """Record more than fits. Require a finished file of the first ticks, and a loop that was drained to its end."""
    rows = make_rows(80_000)
    code, totals = recorder.record(path, rows)
    assert (code, totals["complete"], recorder.loop.cursor) == (1, False, len(rows))  # The recorder continued to drain.
    assert "No space left" in totals["error"] or "File too large" in totals["error"]
    logged = read_rows(path)
    assert 0 < len(logged) == totals["ticks_logged"] == len(rows) - totals["ticks_lost"]
    assert logged.tobytes() == rows[: len(logged)].tobytes()
    with Reader(path) as reader:  # The file is finished, with its index.
        assert (reader.problems, reader.totals["ticks_lost"]) == ([], totals["ticks_lost"])
        assert reader.totals["error"] == totals["error"]


def test_a_file_size_limit_ends_the_file_well(recorder, path):
    resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))
    check_full_disk(recorder, path)


def test_a_full_disk_ends_the_file_well(recorder, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "none", disk], capture_output=True).returncode:
        pytest.skip("mounting a small disk is not permitted here")
    try:
        check_full_disk(recorder, disk / "run.mcap")
    finally:
        subprocess.run(["umount", disk], check=True)


def test_a_disk_with_less_than_the_minimum_free_gets_no_file(recorder, path):
    status = os.statvfs(path.parent)
    recorder.start(path, min_free_bytes=status.f_bavail * status.f_frsize * 2)
    code, totals = recorder.result()
    assert (code, "must stay free" in totals["error"], os.listdir(path.parent)) == (1, True, [])


@pytest.mark.parametrize("rule", [{"rotate_s": 1.0}, {"rotate_bytes": 1_000_000}])
def test_rotation_at_a_snapshot_loses_no_tick(loop, recorder, path, rule):
    rows = make_rows(120_000)
    recorder.start(path, make_header(paced=False), **rule)
    loop.command(0, Mode.CLOSED_LOOP)
    loop.run(rows, slack=SLACK, snapshot_every=4_000)
    code, totals = recorder.end()
    assert (code, totals["complete"], totals["ticks_logged"]) == (0, True, len(rows))
    assert len(totals["paths"]) > 2
    for number, part in enumerate(totals["paths"], start=1):
        assert part.endswith(f"run-{number:04d}.mcap")
        with Reader(part) as reader:
            assert next(reader.blocks())[0, 0] == reader.header["first_tick"] == next(reader.snapshots()).tick
            assert (reader.totals["complete"], reader.totals["ticks_lost"]) == (True, 0)
    pattern = path.with_name("run-*.mcap")
    recording = load(pattern)
    if "rotate_s" in rule:  # The first snapshot that is due after a second is the third one.
        assert [extent.first_tick for extent in recording.extents] == list(range(0, len(rows), 12_000))
    assert (np.concatenate(list(recording.blocks())).tobytes(), recording.problems) == (rows.tobytes(), [])
    os.remove(totals["paths"][1])
    assert load(pattern).problems == ["file 2 of the run is missing"]


def test_event_times_follow_the_deadlines_after_missed_periods(loop, recorder, path):
    rows = make_rows(100)
    rows[50:, 1] += 7e5
    recorder.start(path)
    loop.run(rows)
    recorder.wait_for_ticks(100)
    loop.trip(60)
    loop.trip(110)
    recorder.end()
    times = [event["time_ns"] for event in load(path).events]
    assert times[:2] == [60 * 100_000 + 700_000, 110 * 100_000 + 700_000]
    assert RATE_HZ == 1e9 / 100_000


POLLS = 100
"""Polls of a recorder whose clock stands still; a wait for any time limit would need more polls."""


class EndOfOrders:
    """The stream of orders of a service that is gone."""

    is_closed = True

    def next(self) -> None:
        """Return None: no order arrives any more."""


class EmptyRings:
    """A session whose rings hold no data. Drain number POLLS + 1 raises StillPolling."""

    free_rows, cursor, failure, polls = 1, 0, None, 0

    def drain(self) -> int:
        self.polls += 1
        if self.polls > POLLS:
            raise StillPolling
        return 0

    def write_due(self) -> None:
        """Write no data: the rings are empty."""


class StillPolling(Exception):
    """The recorder continues to poll."""


@pytest.fixture
def frozen_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the recorder's clock; its pauses last no time."""
    monkeypatch.setattr(timing, "source", timing.Source(monotonic_s=lambda: 1_000.0, sleep=lambda _: None))


@pytest.mark.usefixtures("frozen_clock")
def test_a_recorder_without_service_and_loop_ends_at_once(loop):
    assert Recorder(loop.block).record(EmptyRings(), EndOfOrders(), 0.1) == "abandoned"


@pytest.mark.usefixtures("frozen_clock")
def test_a_recorder_without_service_continues_while_a_loop_lives(loop):
    """The ticks of the loop on its way to safe outputs are recorded too."""
    (claimed, claim), (ended, end) = os.pipe(), os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        pid = os.fork()
    if pid == 0:
        try:
            loop.block.claim()
            os.write(claim, b".")
            os.close(end)
            os.read(ended, 1)
        finally:
            os._exit(0)
    os.read(claimed, 1)
    recorder = Recorder(loop.block)
    with pytest.raises(StillPolling):
        recorder.record(EmptyRings(), EndOfOrders(), 0.1)
    os.close(end)
    os.waitpid(pid, 0)
    assert recorder.record(EmptyRings(), EndOfOrders(), 0.1) == "abandoned"
    for descriptor in (claimed, claim, ended):
        os.close(descriptor)

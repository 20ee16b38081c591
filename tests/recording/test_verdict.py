"""`identical` means that every recorded tick was executed and compared, in order, once."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import ChunkIndex

from rtloop.recording.file.topics import format
from rtloop.recording.load import load
from rtloop.recording.replay.replay import ReplayReport, replay
from rtloop.recording.views.summary import summarise
from tests.command_line import answer, run
from tests.recording.forging import CHUNK_TICKS, TICKS, Base, Chunk, first_chunk, pack_changed_snapshot, pack_file


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def tick_chunks(base: Base) -> list[int]:
    """Return the places of the chunks of ticks."""
    return [i for i, chunk in enumerate(base.chunks) if not chunk.channels]


def drop_chunks(base: Base, *places: int) -> Base:
    """Return the recording without the chunks at these places."""
    return base._replace(chunks=[chunk for i, chunk in enumerate(base.chunks) if i not in places])


def drop_snapshots(base: Base, which: set[int]) -> Base:
    """Return the recording without the snapshots number `which`."""
    for number, (i, _) in enumerate(base.messages(format.LAW)):
        if number in which:
            messages = [message for message in base.chunks[i].messages if message.channel != format.LAW]
            base = base.replace_chunk(i, base.chunks[i].replace_messages(messages))
    return base


def unverified_report(path: Path) -> ReplayReport:
    """Replay by API and command. Require no difference, and no verdict `identical`. Returns the report."""
    report, verdict = replay(load(path)), answer("replay", path, code=1)
    assert (report.identical, report.first_difference, verdict["identical"]) == (False, None, False)
    assert verdict["not_verified"] == report.not_verified != []
    text = run("replay", path).stdout
    assert ("not verified" in text, "identical:" in text) == (True, False)
    return report


def test_a_good_recording_is_identical_and_lists_what_is_not_judged(base: Base, path: Path):
    path.write_bytes(pack_file(base))
    report = replay(load(path))
    assert (report.identical, report.ticks, report.not_verified, report.unverified) == (True, TICKS, [], 0)
    not_judged = " ".join(answer("replay", path)["not_judged"])
    assert all(word in not_judged for word in ("lateness_us", "x_true_position_um", "events", "configuration"))
    assert "not judged: " in run("replay", path).stdout


def test_ticks_of_a_damaged_chunk_are_unverified(base: Base, path: Path):
    place = tick_chunks(base)[2]
    path.write_bytes(pack_with_damaged_chunk(base, place))
    report = unverified_report(path)
    assert any("is damaged" in problem for problem in report.problems)
    assert {"first_tick": 2 * CHUNK_TICKS, "count": CHUNK_TICKS} in map(tick_range, report.not_verified)
    assert report.ticks + report.unverified == TICKS


def pack_with_damaged_chunk(base: Base, place: int) -> bytes:
    """Pack the file with one damaged byte in the content of a chunk."""
    content = base.chunks[place].content
    marked = pack_file(base.replace_chunk(place, base.chunks[place]._replace(content=content[:-1] + b"\x5a")))
    original = pack_file(base)
    start = next(i for i, (byte, mark) in enumerate(zip(original, marked, strict=False)) if byte != mark)
    data = bytearray(original)
    data[start] ^= 1
    return bytes(data)


def tick_range(entry: dict[str, Any]) -> dict[str, int]:
    """Return the first tick and the count of an entry of `not_verified`."""
    return {key: entry[key] for key in ("first_tick", "count")}


def test_a_damaged_chunk_with_a_snapshot_is_a_problem(base: Base, path: Path):
    path.write_bytes(pack_with_damaged_chunk(base, base.messages(format.LAW)[3][0]))
    for problems in (unverified_report(path).problems, load(path).problems):
        assert any("is damaged" in problem for problem in problems)


def test_a_chunk_replaced_by_a_copy_of_another_is_unverified(base: Base, path: Path):
    chunks = tick_chunks(base)
    path.write_bytes(pack_file(base.replace_chunk(chunks[4], base.chunks[chunks[1]])))
    report = unverified_report(path)
    assert tick_range(report.not_verified[0]) == {"first_tick": 4 * CHUNK_TICKS, "count": CHUNK_TICKS}
    summary = summarise(path)
    assert (summary.ticks_logged, summary.ticks_lost, summary.complete) == (TICKS - 100, 100, False)
    assert any("again" in problem or "order" in problem for problem in summary.problems)
    for command in (["plot", "--html"], ["export", "--to", "csv"]):
        assert any("order" in problem for problem in answer(command[0], path, *command[1:])["problems"])


def test_commands_that_are_recorded_twice_are_unverified(base: Base, path: Path):
    """A command that is executed twice changes no output, but it did not happen."""
    events = next(i for i, chunk in enumerate(base.chunks) if chunk.messages and "reset_trip" in str(chunk.messages))
    chunks = [*base.chunks[:events], base.chunks[events], *base.chunks[events:]]
    path.write_bytes(pack_file(base._replace(chunks=chunks)))
    assert "a command is recorded twice" in unverified_report(path).not_verified[0]["why"]


@pytest.mark.parametrize("present", [slice(0, -1), slice(1, None), slice(0, None, 2)], ids=["end", "start", "middle"])
def test_ticks_of_missing_chunks_are_unverified(present: slice, base: Base, path: Path):
    missing = set(tick_chunks(base)) - set(tick_chunks(base)[present])
    path.write_bytes(pack_file(drop_chunks(base, *missing)))
    report = unverified_report(path)
    assert report.ticks + report.unverified == TICKS
    assert any(str(TICKS - 100 * len(missing)) in problem for problem in summarise(path).problems)


def test_ticks_before_the_first_snapshot_are_unverified(base: Base, path: Path):
    def raise_drive(chunk: Chunk) -> Chunk:
        records = np.frombuffer(chunk.content, base.dtype).copy()
        records["x_drive_v"] += 1.0
        return Chunk(records.tobytes())

    late_base = drop_snapshots(base, {0, 1})
    place = tick_chunks(late_base)[0]
    path.write_bytes(pack_file(late_base.replace_chunk(place, raise_drive(late_base.chunks[place]))))
    report = unverified_report(path)
    assert (report.unverified, tick_range(report.not_verified[0])) == (200, {"first_tick": 0, "count": 200})
    assert report.ticks == TICKS - 200


def begin_earlier(index: list[ChunkIndex]) -> None:
    """Make the entry of one chunk begin within the chunk before it."""
    index[3] = replace(index[3], chunk_start_offset=index[3].chunk_start_offset - 40)


@pytest.mark.parametrize("forge", [lambda index: index.pop(3), begin_earlier], ids=["missing chunk", "overlap"])
def test_an_index_that_contradicts_the_chunks_is_not_used(
    forge: Callable[[list[ChunkIndex]], object], base: Base, path: Path
):
    path.write_bytes(pack_file(base, forge=forge))
    report = replay(load(path))
    assert any("chunk index" in problem for problem in report.problems)
    assert (report.identical, report.ticks, report.snapshots) == (True, TICKS, 4)


@pytest.mark.parametrize("which", [3, 4])
def test_a_snapshot_after_the_end_is_reported(which: int, base: Base, path: Path):
    path.write_bytes(pack_changed_snapshot(base, "tick", 4_000, which))
    assert any("4000" in entry["why"] for entry in unverified_report(path).not_verified)


def test_a_recording_without_its_end_is_unverified(base: Base, path: Path):
    path.write_bytes(pack_file(drop_chunks(base, len(base.chunks) - 1)))
    assert "has no recorded end" in unverified_report(path).not_verified[-1]["why"]


@pytest.mark.parametrize("rate_hz", [5_000.0, 11_000.0])
def test_a_rate_that_the_deadlines_contradict_is_a_difference(rate_hz: float, base: Base, path: Path):
    path.write_bytes(pack_file(base, first_chunk({**base.header, "rate_hz": rate_hz}, base.header["columns"])))
    assert not replay(load(path)).identical


def change_ticks(base: Base, change: Callable[[np.ndarray], None]) -> Base:
    """Return the recording with the tick records of each chunk changed by `change`; log times follow the deadlines."""
    for i in tick_chunks(base):
        records = np.frombuffer(base.chunks[i].content, base.dtype).copy()
        before_ns = records["deadline_ns"].copy()
        change(records)
        for name in ("_log_time", "_publish_time"):
            records[name] += (records["deadline_ns"] - before_ns).astype(np.uint64)
        base = base.replace_chunk(i, Chunk(records.tobytes()))
    return base


def test_periods_that_were_missed_are_no_wrong_rate(base: Base, path: Path):
    """Every tenth tick is a period late; a rate that ignores missed periods would be 9 % off."""

    def delay_ticks(records: np.ndarray) -> None:
        records["deadline_ns"] += 100_000 * (records["tick"] // 10)
        records["periods_missed"] = (records["tick"] % 10 == 0) & (records["tick"] > 0)

    path.write_bytes(pack_file(change_ticks(base, delay_ticks)))
    assert replay(load(path)).first_difference is None


def test_a_wrong_rate_is_told_with_that_of_the_deadlines(base: Base, path: Path):
    def double_deadlines(records: np.ndarray) -> None:
        records["deadline_ns"] *= 2

    path.write_bytes(pack_file(change_ticks(base, double_deadlines)))
    difference = replay(load(path)).first_difference
    assert difference == {"tick": 0, "signal": "rate_hz", "recorded": 10_000.0, "replayed": pytest.approx(5_000.0)}


@pytest.mark.parametrize("tick", [0, 299, 377])
def test_ticks_are_counted_up_to_the_one_that_differs(tick: int, base: Base, path: Path):
    def change_drive(records: np.ndarray) -> None:
        records["x_drive_v"][records["tick"] == tick] += 1e-9

    path.write_bytes(pack_file(change_ticks(base, change_drive)))
    report = replay(load(path))
    assert report.first_difference is not None
    assert (report.first_difference["tick"], report.first_difference["signal"]) == (tick, "x_drive_v")
    assert report.ticks == tick + 1


@pytest.mark.parametrize(("lost", "unverified"), [((3, 4), 0), ((1, 2), 50)])
def test_a_recorded_gap_is_no_unverified_tick(lost: tuple[int, int], unverified: int, base: Base, path: Path):
    """Lost ticks were never recorded; later ticks are compared from the next snapshot on."""
    gap = {"first_tick": 100 * lost[0], "count": 200}
    path.write_bytes(pack_with_gap(base, lost, gap))
    report = replay(load(path))
    assert (report.gaps, report.unverified, report.identical) == ([gap], unverified, unverified == 0)
    assert report.ticks == TICKS - 200 - unverified


def pack_with_gap(base: Base, lost: tuple[int, int], gap: dict[str, int]) -> bytes:
    """Pack the recording without two chunks of ticks, with a gap event and the recorder's totals."""
    chunks = tick_chunks(base)
    base = drop_chunks(base, *(chunks[i] for i in lost))
    event = {"tick": 400, "time_ns": 0, "kind": "gap", "who": "recorder", "axis": None, "what": gap}
    (last,), place = base.chunks[-1].messages, len(base.chunks) - 1
    end = json.loads(last.payload)
    end["what"] |= {"ticks_logged": TICKS - 200, "ticks_lost": 200, "complete": False}
    messages = [last._replace(payload=json.dumps(content).encode()) for content in (event, end)]
    return pack_file(base.replace_chunk(place, base.chunks[place].replace_messages(messages)))


def test_missing_ticks_beyond_the_recorded_gap_are_unverified(base: Base, path: Path):
    path.write_bytes(pack_with_gap(base, (3, 4), {"first_tick": 300, "count": 100}))
    assert [*map(tick_range, unverified_report(path).not_verified)] == [{"first_tick": 300, "count": 200}]

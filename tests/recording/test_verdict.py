"""`identical` means that every recorded tick was executed and compared, in order, once; anything less is said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.records import ChunkIndex

from rtloop.cli import main
from rtloop.recording.file.topics import format
from rtloop.recording.load import load
from rtloop.recording.replay.replay import ReplayReport, replay
from rtloop.recording.views.summary import summarise
from tests.recording.forging import CHUNK_TICKS, TICKS, Base, Chunk, first_chunk, packed, with_snapshot


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def tick_chunks(base: Base) -> list[int]:
    return [i for i, chunk in enumerate(base.chunks) if not chunk.channels]


def without(base: Base, *places: int) -> Base:
    return base._replace(chunks=[chunk for i, chunk in enumerate(base.chunks) if i not in places])


def without_snapshots(base: Base, which: set[int]) -> Base:
    """The recording without some of its snapshots."""
    for number, (i, _) in enumerate(base.messages(format.LAW)):
        if number in which:
            kept = [one for one in base.chunks[i].messages if one.channel != format.LAW]
            base = base.with_chunk(i, base.chunks[i].with_messages(kept))
    return base


def refused(path: Path) -> ReplayReport:
    """The report of a replay that must not be called identical, by any way."""
    report = replay(load(path))
    assert not report.identical
    assert report.first_difference is None
    assert report.not_verified
    result = CliRunner().invoke(main, ["replay", str(path), "--json"])
    verdict = json.loads(result.stdout)
    assert (result.exit_code, verdict["identical"]) == (1, False)
    assert verdict["not_verified"] == report.not_verified
    words = CliRunner().invoke(main, ["replay", str(path)]).stdout
    assert "not verified" in words
    assert "identical:" not in words
    return report


def test_a_good_recording_is_identical_and_says_what_is_not_judged(base: Base, path: Path):
    path.write_bytes(packed(base))
    report = replay(load(path))
    assert (report.identical, report.ticks, report.not_verified, report.unverified) == (True, TICKS, [], 0)
    verdict = json.loads(CliRunner().invoke(main, ["replay", str(path), "--json"]).stdout)
    not_judged = " ".join(verdict["not_judged"])
    for what in ("lateness_us", "x_true_position_um", "events", "configuration"):
        assert what in not_judged, what
    assert "not judged: " in CliRunner().invoke(main, ["replay", str(path)]).stdout


def test_a_damaged_chunk_of_ticks(base: Base, path: Path):
    place = tick_chunks(base)[2]
    path.write_bytes(damaged(base, place))
    report = refused(path)
    assert any("is damaged" in problem for problem in report.problems)
    assert {"first_tick": 2 * CHUNK_TICKS, "count": CHUNK_TICKS} in [ranges(one) for one in report.not_verified]
    assert report.ticks + report.unverified == TICKS


def damaged(base: Base, place: int) -> bytes:
    """The file with one byte of the content of a chunk flipped, its checksum not renewed."""
    content = base.chunks[place].content
    marked = packed(base.with_chunk(place, base.chunks[place]._replace(content=content[:-1] + b"\x5a")))
    whole = packed(base)
    start = next(i for i, (one, other) in enumerate(zip(whole, marked, strict=False)) if one != other)
    data = bytearray(whole)
    data[start] ^= 1
    return bytes(data)


def ranges(entry: dict[str, Any]) -> dict[str, int]:
    return {key: entry[key] for key in ("first_tick", "count")}


@pytest.mark.parametrize("which", [3])
def test_a_damaged_chunk_with_a_snapshot(which: int, base: Base, path: Path):
    place = base.messages(format.LAW)[which][0]
    path.write_bytes(damaged(base, place))
    report = refused(path)
    assert any("is damaged" in problem for problem in report.problems)
    assert any("is damaged" in problem for problem in load(path).problems)


def test_a_chunk_replaced_by_a_copy_of_another(base: Base, path: Path):
    chunks = tick_chunks(base)
    path.write_bytes(packed(base.with_chunk(chunks[4], base.chunks[chunks[1]])))
    report = refused(path)
    assert ranges(report.not_verified[0]) == {"first_tick": 4 * CHUNK_TICKS, "count": CHUNK_TICKS}
    summary = summarise(path)
    assert (summary.ticks_logged, summary.ticks_lost, summary.complete) == (TICKS - 100, 100, False)
    assert any("again" in problem or "order" in problem for problem in summary.problems)
    for command in (["plot", "--html"], ["export", "--to", "csv"]):
        result = CliRunner().invoke(main, [command[0], str(path), *command[1:], "--json"])
        assert any("order" in problem for problem in json.loads(result.stdout)["problems"])


def test_commands_that_stand_there_twice(base: Base, path: Path):
    """They change nothing, twice obeyed; and yet this is not the recording of what happened."""
    events = next(i for i, chunk in enumerate(base.chunks) if chunk.messages and "reset_trip" in str(chunk.messages))
    chunks = list(base.chunks)
    chunks.insert(events, base.chunks[events])
    path.write_bytes(packed(base._replace(chunks=chunks)))
    report = refused(path)
    assert "a command is recorded twice" in report.not_verified[0]["why"]


@pytest.mark.parametrize("kept", [slice(0, -1), slice(1, None), slice(0, None, 2)], ids=["end", "start", "middle"])
def test_chunks_that_are_gone(kept: slice, base: Base, path: Path):
    gone = set(tick_chunks(base)) - set(tick_chunks(base)[kept])
    path.write_bytes(packed(without(base, *gone)))
    report = refused(path)
    assert report.ticks + report.unverified == TICKS
    assert any(str(TICKS - 100 * len(gone)) in problem for problem in summarise(path).problems)


def test_early_snapshots_that_are_gone(base: Base, path: Path):
    def altered(chunk: Chunk) -> Chunk:
        records = np.frombuffer(chunk.content, base.dtype).copy()
        records["x_drive_v"] += 1.0
        return Chunk(records.tobytes())

    bare = without_snapshots(base, {0, 1})
    place = tick_chunks(bare)[0]
    path.write_bytes(packed(bare.with_chunk(place, altered(bare.chunks[place]))))
    report = refused(path)
    assert (report.unverified, ranges(report.not_verified[0])) == (200, {"first_tick": 0, "count": 200})
    assert report.ticks == TICKS - 200


def test_an_index_that_leaves_a_chunk_out_is_not_used(base: Base, path: Path):
    path.write_bytes(packed(base, forge=lambda index: index.pop(3)))
    report = replay(load(path))
    assert any("chunk index" in problem for problem in report.problems)
    assert (report.identical, report.ticks, report.snapshots) == (True, TICKS, 4)


@pytest.mark.parametrize("which", [3, 4])
def test_a_snapshot_that_is_put_behind_the_end(which: int, base: Base, path: Path):
    path.write_bytes(with_snapshot(base, "tick", 4_000, which))
    assert any("4000" in entry["why"] for entry in refused(path).not_verified)


def test_a_recording_that_states_no_end(base: Base, path: Path):
    path.write_bytes(packed(without(base, len(base.chunks) - 1)))
    assert "states no end" in refused(path).not_verified[-1]["why"]


@pytest.mark.parametrize("rate_hz", [5_000.0, 11_000.0])
def test_another_rate_than_the_deadlines_follow(rate_hz: float, base: Base, path: Path):
    path.write_bytes(packed(base, first_chunk({**base.header, "rate_hz": rate_hz}, base.header["columns"])))
    assert not replay(load(path)).identical


def test_a_gap_that_the_recorder_accounted_for(base: Base, path: Path):
    """What was never recorded is no recorded tick; what comes behind it is compared from the next snapshot on."""
    chunks = tick_chunks(base)
    event = {"tick": 400, "time_ns": 0, "kind": "gap", "who": "recorder", "axis": None}
    for lost, passed_over in (((3, 4), 0), ((1, 2), 50)):
        gap = {"first_tick": 100 * lost[0], "count": 200}
        path.write_bytes(
            packed(with_gap(without(base, *(chunks[i] for i in lost)), {**event, "what": gap}, TICKS - 200))
        )
        report = replay(load(path))
        assert (report.gaps, report.unverified, report.identical) == ([gap], passed_over, passed_over == 0)
        assert report.ticks == TICKS - 200 - passed_over


def with_gap(base: Base, gap: dict[str, Any], logged: int) -> Base:
    """The recording with the recorder's word for a gap, and what it counted."""
    (last,), place = base.chunks[-1].messages, len(base.chunks) - 1
    end = json.loads(last.payload)
    end["what"] |= {"ticks_logged": logged, "ticks_lost": TICKS - logged, "complete": False}
    messages = [last._replace(payload=json.dumps(event).encode()) for event in (gap, end)]
    return base.with_chunk(place, base.chunks[place].with_messages(messages))


def test_an_index_with_a_chunk_that_begins_within_another_is_not_used(base: Base, path: Path):
    def begin_earlier(index: list[ChunkIndex]) -> None:
        index[3] = replace(index[3], chunk_start_offset=index[3].chunk_start_offset - 40)

    path.write_bytes(packed(base, forge=begin_earlier))
    report = replay(load(path))
    assert any("chunk index" in problem for problem in report.problems)
    assert (report.identical, report.ticks) == (True, TICKS)


def test_a_hole_that_is_larger_than_the_gap_that_the_recorder_told_of_is_not_verified(base: Base, path: Path):
    chunks = tick_chunks(base)
    event = {"tick": 400, "time_ns": 0, "kind": "gap", "who": "recorder", "axis": None}
    gap = {"first_tick": 300, "count": 100}
    lacking = without(base, chunks[3], chunks[4])
    path.write_bytes(packed(with_gap(lacking, {**event, "what": gap}, TICKS - 200)))
    report = refused(path)
    assert [ranges(one) for one in report.not_verified] == [{"first_tick": 300, "count": 200}]

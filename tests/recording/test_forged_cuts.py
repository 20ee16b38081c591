"""Recordings forged where spans are cut: any number of jobs gives the same answer, and none is too good."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.recording.file.topics import format
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from tests.recording import forged_cuts
from tests.recording.forged_cuts import JOBS, NOWHERE, Original, Part, answer, check, pack_record
from tests.recording.forging import Chunk

NUMBERS = range(8)


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Original]:
    """The good recordings by name."""
    return {original.name: original for original in forged_cuts.record_originals(tmp_path_factory.mktemp("originals"))}


@pytest.fixture
def part(originals: dict[str, Original]) -> Part:
    """The file of the recording of one axis."""
    return originals["one axis"].run[0]


def write(folder: Path, *parts: Part) -> list[Path]:
    """Write the files of a recording. Returns their paths."""
    paths = [folder / f"{number}.mcap" for number in range(len(parts))]
    for path, part in zip(paths, parts, strict=True):
        path.write_bytes(part.pack())
    return paths


def require_not_identical(paths: list[Path]) -> dict[str, Any]:
    """Require the same report that is not identical for all numbers of jobs. Returns it."""
    first, *others = (answer(paths, jobs) for jobs in JOBS)
    assert isinstance(first, dict)
    assert not first["identical"]
    assert all(other == first for other in others)
    return first


def test_the_good_recordings_are_identical(originals: dict[str, Original], tmp_path: Path):
    assert len(originals) == 7
    for original in originals.values():
        paths = write(tmp_path, *original.run)
        single, in_spans = answer(paths, 1), answer(paths, 16)
        assert isinstance(single, dict)
        assert (single["identical"], in_spans) == (True, single)


def test_forged_recordings_get_one_answer_which_is_not_too_good(originals: dict[str, Original], tmp_path: Path):
    """`make soak NAME=forged` tries 500."""
    results = [check([*originals.values()], tmp_path, number) for number in NUMBERS]
    assert not [fault for fault, _ in results if fault]
    assert {is_identical for _, is_identical in results} == {True, False}


def raise_drive(part: Part, place: int, row: int) -> Chunk:
    """Return a chunk of ticks with another drive from `row` on."""
    records = part.records(place)
    records["x_drive_v"][row:] = 9.99
    return Chunk(records.tobytes())


@pytest.mark.parametrize("which", [0, 3, 9, 16, 29])
def test_a_chunk_written_twice_first_forged_is_found(which: int, part: Part, tmp_path: Path):
    """The forged copy differs behind the snapshot, if the chunk has one; else from its second tick on."""
    place = part.tick_chunks[which]
    ticks = part.records(place)["tick"]
    row = int(np.searchsorted(ticks, -(-ticks[0] // 20) * 20)) + 1
    chunks = [*part.base.chunks]
    chunks.insert(place, raise_drive(part, place, row))
    report = require_not_identical(write(tmp_path, part.with_chunks(chunks)))
    assert report["first_difference"]["tick"] == ticks[row]


def hidden_chunks(part: Part) -> dict[str, Part]:
    """Return the recording with a forged chunk at each place where a reader could overlook it."""
    place = part.tick_chunks[5]
    forged = raise_drive(part, place, 0)
    slow = next(i for i, chunk in enumerate(part.base.chunks) if chunk.channels)
    slow_chunk, size = part.base.chunks[slow], part.base.dtype.itemsize
    added = part.with_chunks([*part.base.chunks[:place], forged, *part.base.chunks[place:]])
    records = [forged.content[k : k + size] for k in range(0, len(forged.content), size)]
    unknown = b"".join(record[:9] + NOWHERE.to_bytes(2, "little") + record[11:] for record in records)

    def extend(content: bytes) -> Part:
        longer = slow_chunk._replace(content=slow_chunk.content + content)
        return part._replace(base=part.base.replace_chunk(slow, longer))

    return {
        "message indexes": part._replace(nested={place: forged.content}),
        "message indexes of messages": part._replace(nested={slow: forged.content}),
        "summary": part._replace(appended=(forged.content,)),
        "other messages": extend(forged.content),
        "nested": extend(pack_record(forged.content)),
        **{
            f"index {channel}": added._replace(channels={place: (channel,)})
            for channel in (format.EVENTS, format.CONFIGURATION, format.OVERVIEW, NOWHERE)
        },
        "index of messages": part._replace(channels={slow: ()}),
        "unknown channel": part.with_chunks([Chunk(unknown, (format.EVENTS,)), *part.base.chunks]),
        "unknown channel, named": part.with_chunks([Chunk(unknown, (NOWHERE,)), *part.base.chunks]),
    }


@pytest.mark.parametrize(
    "place",
    [
        *("message indexes", "message indexes of messages", "summary", "other messages", "nested", "index 2"),
        *("index 4", "index 5", f"index {NOWHERE}", "index of messages", "unknown channel", "unknown channel, named"),
    ],
)
def test_no_chunk_is_hidden(place: str, part: Part, tmp_path: Path):
    report = require_not_identical(write(tmp_path, hidden_chunks(part)[place]))
    assert report["problems"] or report["first_difference"]


def test_a_recording_without_its_first_ticks_is_not_identical(part: Part, tmp_path: Path):
    """The snapshot of tick 60 would be a beginning, and the totals agree."""
    first = part.tick_chunks[3]
    assert part.records(first)["tick"][0] == 60
    chunks = [chunk for place, chunk in enumerate(part.base.chunks) if place >= first or chunk.channels]
    chunks = [
        chunk
        for chunk in chunks
        if not any(m.channel == format.LAW and m.payload[32:40] == bytes(8) for m in chunk.messages)
    ]
    shorter = forged_cuts.change_totals(part.with_chunks(chunks), lambda totals: totals.update(ticks_logged=540))
    entry = require_not_identical(write(tmp_path, shorter))["not_verified"][0]
    assert (entry["first_tick"], entry["count"]) == (0, 60)


def test_totals_of_two_files_that_are_wrong_in_sum_only_are_found(originals: dict[str, Original], tmp_path: Path):
    first, second, *others = originals["rotated"].run

    def add(part: Part, count: int) -> Part:
        return forged_cuts.change_totals(
            part, lambda totals: totals.update(ticks_logged=totals["ticks_logged"] + count)
        )

    require_not_identical(write(tmp_path, add(first, 20), add(second, -20), *others))


def test_ticks_and_commands_that_a_replacement_repeats_must_be_those_of_the_killed_recorder(
    originals: dict[str, Original], tmp_path: Path
):
    first, second = originals["killed recorder"].run
    (extent,) = load(write(tmp_path, first, second)).extents[1:]
    place = second.tick_chunks[0]
    assert (extent.repeated, len(second.records(place)) >= 40) == (40, True)
    for tick in (321, 359):
        records = second.records(place)
        records["x_drive_v"][records["tick"] == tick] = 9.99
        (entry,) = require_not_identical(write(tmp_path, first, second.with_records(place, records)))["not_verified"]
        assert (entry["first_tick"], entry["count"]) == (320, 40)


@pytest.mark.parametrize(("tick", "is_identical"), [(600, True), (601, False), (10**6, False)])
def test_a_command_after_the_end_is_not_verified(tick: int, is_identical: bool, part: Part, tmp_path: Path):
    late = forged_cuts.add_command(part, tick)
    assert replay(load(write(tmp_path, late))).identical == is_identical

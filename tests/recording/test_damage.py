"""Whatever happens to the bytes of a file: right numbers, or a clear word about what is wrong; never a wrong one."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as StockWriter

from rtloop.errors import OutputError, RtloopError
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.container import DATA_END_BYTES
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.writer import Writer
from rtloop.recording.views.summary import summarise
from tests.recording.hand_made_loop import START_UNIX_NS, make_header, make_rows, snapshot, write_recording

COUNT = 4_000
DAMAGED = 150
"""Copies of each kind; a thousand, and more is done with each: `make soak NAME=recordings`."""
ROWS = make_rows(COUNT)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_recording(tmp_path_factory.mktemp("damage") / "run.mcap", ROWS).read_bytes()


@pytest.fixture(scope="module")
def unfinished(finished: bytes) -> bytes:
    """The file as it was before its end was written."""
    (start,) = struct.unpack_from("<Q", finished, len(finished) - 8 - 20)
    return finished[: start - DATA_END_BYTES]


def check(path: Path) -> int:
    """Everything that can be read is right, and what cannot be is said; returns the ticks read."""
    said = ""
    try:
        with Reader(path, tolerant=True) as reader:
            blocks = list(reader.blocks())
            events, snapshots, problems = reader.events, list(reader.snapshots()), reader.problems
            header = reader.header
    except RtloopError as error:
        said = str(error)
    if said:
        assert said.startswith(f"{path}: ")
        return 0
    assert {key: header[key] for key in make_header()} == make_header()
    rows = np.concatenate([*blocks, np.empty((0, ROWS.shape[1]))])
    ticks = rows[:, 0].astype(int)
    assert np.all(np.diff(ticks) > 0)
    assert rows.tobytes() == ROWS[ticks].tobytes()
    assert all(one.data == snapshot(one.tick).tobytes() for one in snapshots)
    assert all(event["kind"] in ("set_mode", "finished") for event in events)
    if (len(rows), len(events), len(snapshots)) != (COUNT, 5, 4):
        assert problems
    return len(rows)


def damaged(whole: bytes, random: np.random.Generator) -> bytes:
    data = bytearray(whole)
    for position in random.integers(0, len(data), random.integers(1, 3)):
        data[position] ^= int(random.integers(1, 256))
    return bytes(data)


def test_cut_off_anywhere(finished: bytes, tmp_path: Path):
    random = np.random.default_rng(1)
    path = tmp_path / "run.mcap"
    places = [*range(12), *random.integers(12, len(finished), 120), *range(len(finished) - 60, len(finished))]
    read = []
    for place in sorted(places):
        path.write_bytes(finished[:place])
        read.append(check(path))
    assert read == sorted(read)
    assert read[-1] == COUNT


@pytest.mark.parametrize("kind", ["finished", "unfinished"])
def test_a_damaged_byte_anywhere(kind: str, request: pytest.FixtureRequest, tmp_path: Path):
    whole = request.getfixturevalue(kind)
    random = np.random.default_rng(2)
    path = tmp_path / "run.mcap"
    for _ in range(DAMAGED):
        path.write_bytes(damaged(whole, random))
        check(path)


def test_damaged_fields_of_records(unfinished: bytes, finished: bytes, tmp_path: Path):
    """Each byte of the file's header, of a chunk's header and of the footer, one after the other."""
    path = tmp_path / "run.mcap"
    second = unfinished.index(b"\x04\0\0\0zstd", 200) - 37
    for whole, places in ((unfinished, [*range(60), *range(second, second + 60)]), (finished, range(-60, 0))):
        for place in places:
            data = bytearray(whole)
            data[place] ^= 0x10
            path.write_bytes(data)
            check(path)


def test_a_damaged_chunk_is_an_error_unless_asked_otherwise(finished: bytes, tmp_path: Path):
    path = tmp_path / "run.mcap"
    data = bytearray(finished)
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with Reader(path) as reader, pytest.raises(RecordingError, match=r"is damaged.*rtloop recover"):
        list(reader.blocks())
    summary = summarise(path)
    assert not summary.complete
    assert summary.ticks_lost == COUNT - summary.ticks_logged > 0
    assert len(summary.problems) == 1


def test_recovering_a_damaged_file(finished: bytes, tmp_path: Path):
    path = tmp_path / "run.mcap"
    data = bytearray(finished)
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    report = recover(path)
    assert path.read_bytes() == data
    assert Path(report["output"]).name == "run-recovered.mcap"
    assert sum(count for _, count in report["gaps"]) == COUNT - report["ticks"]
    with Reader(report["output"]) as reader:
        assert reader.problems == []
        rows = np.concatenate(list(reader.blocks()))
        assert rows.tobytes() == ROWS[rows[:, 0].astype(int)].tobytes()
        assert reader.totals is not None
        assert (reader.totals["result"], reader.totals["complete"]) == ("recovered", False)


def test_recovering_cut_off_files(unfinished: bytes, tmp_path: Path):
    random = np.random.default_rng(4)
    for place in random.integers(2_000, len(unfinished), 25):
        path = tmp_path / f"{place}.mcap.part"
        path.write_bytes(unfinished[:place])
        report = recover(path)
        with Reader(report["output"]) as reader:
            assert reader.problems == []
            assert reader.start_unix_ns == START_UNIX_NS or report["ticks"] == 0
            rows = np.concatenate([*reader.blocks(), np.empty((0, ROWS.shape[1]))])
        assert rows.tobytes() == ROWS[: report["ticks"]].tobytes()
        assert report["gaps"] == []
        assert not report["complete"]


def test_recovering_a_file_that_only_lacks_its_index(unfinished: bytes, tmp_path: Path):
    path = tmp_path / "run.mcap.part"
    path.write_bytes(unfinished)
    report = recover(path)
    assert (report["ticks"], report["gaps"]) == (COUNT, [])
    summary = summarise(report["output"])
    assert (summary.ticks_logged, summary.ticks_lost) == (COUNT, 0)
    with pytest.raises(OutputError, match="exists already"):
        recover(path)


def _stock_file(path: Path) -> None:
    with path.open("wb") as file:
        writer = StockWriter(file)
        writer.start()
        channel = writer.register_channel("/chatter", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()


def _newer(path: Path) -> None:
    write_recording(path, ROWS[:10], format=format.FORMAT + 1)


def _other_columns(path: Path) -> None:
    """A header whose columns are not those of the schema."""
    header = make_header()
    writer = Writer(path, header, 1)
    writer._file.drop_last_chunk()
    header["columns"] = [*header["columns"][:-1], "another_um"]
    repeated = [*format.schemas(make_header()["columns"]), *format.channels()]
    writer._write_header(header, 1, repeated)
    writer.finish(lambda _: _end())


def _end() -> Message:
    return Message(format.EVENTS, 1, json.dumps({"kind": "finished", "what": {}}).encode())


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "nothing": (lambda path: None, "no such file"),
    "folder": (lambda path: path.mkdir(), "Is a directory"),
    "empty": (lambda path: path.write_bytes(b""), "an empty file"),
    "text": (lambda path: path.write_text("tick,x\n0,1\n"), "not an MCAP file"),
    "magic only": (lambda path: path.write_bytes(b"\x89MCAP0\r\n"), "not a recording of rtloop"),
    "someone else's": (_stock_file, "not a recording of rtloop"),
    "newer": (_newer, "newer than this version reads"),
    "other columns": (_other_columns, "does not match the recorded columns"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_inputs_get_one_clear_message(case: str, tmp_path: Path):
    path = tmp_path / "run.mcap"
    make, message = WRONG[case]
    make(path)
    for use in (Reader, summarise, recover):
        with pytest.raises(RecordingError, match=message) as caught:
            use(path)
        assert caught.value.exit_code == 66
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_an_unfinished_run_is_pointed_to(finished: bytes, tmp_path: Path):
    (tmp_path / "run.mcap.part").write_bytes(finished)
    with pytest.raises(RecordingError, match=r"there is run\.mcap\.part"):
        Reader(tmp_path / "run.mcap")


def test_an_unwritable_folder(tmp_path: Path):
    with pytest.raises(OutputError, match="No such file or directory") as caught:
        write_recording(tmp_path / "absent" / "run.mcap", ROWS[:10])
    assert caught.value.exit_code == 73
    shutil.rmtree(tmp_path)


@pytest.mark.parametrize("place", [2, -2])
def test_a_recovered_file_without_a_chunk_of_events_and_snapshots_has_no_complete_end(tmp_path: Path, place: int):
    """Every tick is there: what is missing is said by the chunk alone."""
    path = write_recording(tmp_path / "run.mcap", ROWS)
    with Reader(path) as reader:
        slow = [entry for entry in reader.entries if entry.index and format.LAW in entry.index.message_index_offsets]
    data = bytearray(path.read_bytes())
    data[slow[place].offset + slow[place].length - 1] ^= 1
    path.write_bytes(data)
    report = recover(path)
    assert (report["ticks"], report["gaps"], report["complete"]) == (COUNT, [], False)
    (problem,) = report["problems"]
    assert f"the chunk at byte {slow[place].offset} is damaged" in problem
    with Reader(report["output"]) as reader:
        assert (reader.totals["result"], reader.totals["complete"]) == ("recovered", False)
        assert reader.totals["problems"] == [problem]

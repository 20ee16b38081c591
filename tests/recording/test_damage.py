"""Any damage of a file: every number that is read is right, and a message names the fault."""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as StockWriter

from rtloop.errors import OutputError, RtloopError
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.chunks import McapSource, read_chunk_index, scan_chunks
from rtloop.recording.file.mcap.container import DATA_END_BYTES
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics import format
from rtloop.recording.file.writer import Writer
from rtloop.recording.views.summary import summarise
from tests.recording.hand_made_loop import (
    START_UNIX_NS,
    final_message,
    make_header,
    make_rows,
    snapshot,
    write_recording,
)
from tests.recording.tamper import flip_byte

COUNT = 4_000
COPIES = 150
"""Damaged copies of each kind; `make soak NAME=recordings` tries a thousand."""
ROWS = make_rows(COUNT)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Bytes of a finished file with ROWS."""
    return write_recording(tmp_path_factory.mktemp("damage") / "run.mcap", ROWS).read_bytes()


@pytest.fixture(scope="module")
def unfinished(finished: bytes) -> bytes:
    """Bytes of the same file before its end was written."""
    (start,) = struct.unpack_from("<Q", finished, len(finished) - 8 - 20)
    return finished[: start - DATA_END_BYTES]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def require_right_data(path: Path) -> int:
    """Require that all readable data is right, and that a message names the fault. Returns the number of read ticks."""
    try:
        with Reader(path, tolerant=True) as reader:
            blocks, snapshots = list(reader.blocks()), list(reader.snapshots())
            events, problems, header = reader.events, reader.problems, reader.header
    except RtloopError as error:
        assert str(error).startswith(f"{path}: ")  # noqa: PT017
        return 0
    assert {key: header[key] for key in make_header()} == make_header()
    rows = np.concatenate([*blocks, np.empty((0, ROWS.shape[1]))])
    ticks = rows[:, 0].astype(int)
    assert np.all(np.diff(ticks) > 0)
    assert rows.tobytes() == ROWS[ticks].tobytes()
    assert all(read.data == snapshot(read.tick).tobytes() for read in snapshots)
    assert all(event["kind"] in ("set_mode", "finished") for event in events)
    assert problems or (len(rows), len(events), len(snapshots)) == (COUNT, 5, 4)
    return len(rows)


def test_a_file_that_is_cut_off_anywhere(finished: bytes, path: Path):
    places = [*range(12), *np.random.default_rng(1).integers(12, len(finished), 120)]
    counts = []
    for place in sorted([*places, *range(len(finished) - 60, len(finished))]):
        path.write_bytes(finished[:place])
        counts.append(require_right_data(path))
    assert (counts, counts[-1]) == (sorted(counts), COUNT)


@pytest.mark.parametrize("kind", ["finished", "unfinished"])
def test_a_file_with_damaged_bytes_anywhere(kind: str, request: pytest.FixtureRequest, path: Path):
    original, random = request.getfixturevalue(kind), np.random.default_rng(2)
    for _ in range(COPIES):
        data = bytearray(original)
        for position in random.integers(0, len(data), random.integers(1, 3)):
            data[position] ^= int(random.integers(1, 256))
        path.write_bytes(data)
        require_right_data(path)


def test_each_damaged_byte_of_a_header_and_a_footer(unfinished: bytes, finished: bytes, path: Path):
    """Each byte is damaged alone: of the file's header, of a chunk's header, of the footer."""
    start = unfinished.index(b"\x04\0\0\0zstd", 200) - 37
    for original, places in ((unfinished, [*range(60), *range(start, start + 60)]), (finished, range(-60, 0))):
        for place in places:
            data = bytearray(original)
            data[place] ^= 0x10
            path.write_bytes(data)
            require_right_data(path)


@pytest.fixture
def damaged(finished: bytes, path: Path) -> Path:
    """A finished file with a damaged chunk."""
    path.write_bytes(finished)
    return flip_byte(path)


def test_a_damaged_chunk_is_an_error_unless_the_reader_is_tolerant(damaged: Path):
    with Reader(damaged) as reader, pytest.raises(RecordingError, match=r"is damaged.*rtloop recover"):
        list(reader.blocks())
    summary = summarise(damaged)
    assert (summary.complete, len(summary.problems)) == (False, 1)
    assert summary.ticks_lost == COUNT - summary.ticks_logged > 0


def test_a_damaged_file_is_recovered_into_a_new_one(damaged: Path):
    data = damaged.read_bytes()
    report = recover(damaged)
    assert (damaged.read_bytes(), Path(report["output"]).name) == (data, "run-recovered.mcap")
    assert sum(count for _, count in report["gaps"]) == COUNT - report["ticks"]
    with Reader(report["output"]) as reader:
        rows = np.concatenate(list(reader.blocks()))
        assert rows.tobytes() == ROWS[rows[:, 0].astype(int)].tobytes()
        assert (reader.problems, reader.totals["result"], reader.totals["complete"]) == ([], "recovered", False)


def test_cut_off_files_are_recovered_up_to_their_end(unfinished: bytes, tmp_path: Path):
    for place in np.random.default_rng(4).integers(2_000, len(unfinished), 25):
        path = tmp_path / f"{place}.mcap.part"
        path.write_bytes(unfinished[:place])
        report = recover(path)
        with Reader(report["output"]) as reader:
            assert reader.start_unix_ns == START_UNIX_NS or report["ticks"] == 0
            rows = np.concatenate([*reader.blocks(), np.empty((0, ROWS.shape[1]))])
        assert rows.tobytes() == ROWS[: report["ticks"]].tobytes()
        assert (reader.problems, report["gaps"], report["complete"]) == ([], [], False)


def test_a_file_without_its_index_is_recovered_completely(unfinished: bytes, tmp_path: Path):
    path = tmp_path / "run.mcap.part"
    path.write_bytes(unfinished)
    report = recover(path)
    summary = summarise(report["output"])
    assert (report["ticks"], report["gaps"], summary.ticks_logged, summary.ticks_lost) == (COUNT, [], COUNT, 0)
    with pytest.raises(OutputError, match="exists already"):
        recover(path)


def write_stock_file(path: Path) -> None:
    """Write an MCAP file of another program."""
    with path.open("wb") as file:
        writer = StockWriter(file)
        writer.start()
        writer.add_message(writer.register_channel("/chatter", "json", 0), 1, b"{}", 1)
        writer.finish()


def write_other_columns(path: Path) -> None:
    """Write a header whose columns differ from the schema."""
    header = make_header()
    writer = Writer(path, header, 1)
    writer.file.drop_last_chunk()
    header["columns"] = [*header["columns"][:-1], "another_um"]
    writer._write_header(header, 1, [*format.schemas(make_header()["columns"]), *format.channels()])
    writer.finish(lambda logged: final_message(0, logged))


INVALID_FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "no such file"),
    "folder": (lambda path: path.mkdir(), "Is a directory"),
    "empty": (lambda path: path.write_bytes(b""), "an empty file"),
    "text": (lambda path: path.write_text("tick,x\n0,1\n"), "not an MCAP file"),
    "magic only": (lambda path: path.write_bytes(b"\x89MCAP0\r\n"), "not a recording of rtloop"),
    "by another program": (write_stock_file, "not a recording of rtloop"),
    "newer": (
        lambda path: write_recording(path, ROWS[:10], format=format.FORMAT + 1), "newer than this version reads",
    ),
    "other columns": (write_other_columns, "does not match the recorded columns"),
}  # fmt: skip


@pytest.mark.parametrize("case", INVALID_FILES)
def test_an_invalid_file_gets_one_clear_message(case: str, path: Path):
    make, message = INVALID_FILES[case]
    make(path)
    for use in (Reader, summarise, recover):
        with pytest.raises(RecordingError, match=message) as caught:
            use(path)
        text = str(caught.value)
        assert (caught.value.exit_code, str(path) in text, "\n" in text) == (66, True, False)


def test_a_file_that_is_refused_is_closed(tmp_path: Path):
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        with pytest.raises(RecordingError, match="Is a directory"):
            Reader(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_chunk_that_cannot_be_dropped_stays(path: Path, monkeypatch: pytest.MonkeyPatch):
    writer = Writer(path, make_header(), 1)
    writer.write_ticks(ROWS)
    chunks, size = len(writer.file), writer.file.size
    monkeypatch.setattr(os, "ftruncate", refuse_to_truncate)
    with pytest.raises(OutputError, match="Input/output error"):
        writer.file.drop_last_chunk()
    monkeypatch.undo()
    assert (len(writer.file), writer.file.size) == (chunks, size)
    writer.finish(lambda logged: final_message(COUNT, logged))
    with Reader(path) as reader:
        assert reader.totals["ticks_logged"] == COUNT


def refuse_to_truncate(*_: object) -> None:
    """Raise the OSError EIO, in place of os.ftruncate."""
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_the_message_about_a_missing_file_names_its_unfinished_file(finished: bytes, path: Path):
    path.with_name("run.mcap.part").write_bytes(finished)
    with pytest.raises(RecordingError, match=r"there is run\.mcap\.part"):
        Reader(path)


def test_a_missing_folder_is_an_error(tmp_path: Path):
    with pytest.raises(OutputError, match="No such file or directory") as caught:
        write_recording(tmp_path / "absent" / "run.mcap", ROWS[:10])
    assert caught.value.exit_code == 73


@pytest.mark.parametrize("place", [2, -2])
def test_a_recovered_file_without_a_chunk_of_events_and_snapshots_is_not_complete(path: Path, place: int):
    """No tick is lost; only the damaged chunk shows the loss of events or snapshots."""
    write_recording(path, ROWS)
    with Reader(path) as reader:
        law_chunks = [entry for entry in reader.entries if entry.index and format.LAW in entry.index.channels]
    entry = law_chunks[place]
    report = recover(flip_byte(path, entry.offset + entry.length - 1))
    assert (report["ticks"], report["gaps"], report["complete"]) == (COUNT, [], False)
    (problem,) = report["problems"]
    assert f"the chunk at byte {entry.offset} is damaged" in problem
    with Reader(report["output"]) as reader:
        totals = reader.totals
    assert (totals["result"], totals["complete"], totals["problems"]) == ("recovered", False, [problem])


def test_a_scan_goes_on_at_the_next_whole_chunk(tmp_path: Path):
    """A damaged head of a chunk loses that chunk and no other, wherever it lies in an unfinished file."""
    path = write_recording(tmp_path / "run.mcap", make_rows(30_000))
    source = McapSource(path)
    chunks, problems = scan_chunks(source)
    assert (len(chunks) > 4, problems) == (True, [])
    assert [chunk.offset for chunk in chunks] == [chunk.offset for chunk in read_chunk_index(source)]
    for number in range(len(chunks) - 1):
        damaged = tmp_path / f"{number}.mcap"
        data = bytearray(path.read_bytes())
        data[chunks[number].offset + 1 : chunks[number].offset + 9] = b"\xff" * 8  # the length of the record
        damaged.write_bytes(data)
        remaining, messages = scan_chunks(McapSource(damaged))
        assert [chunk.offset for chunk in remaining] == [chunk.offset for k, chunk in enumerate(chunks) if k != number]
        assert messages == [f"bytes {chunks[number].offset} to {chunks[number + 1].offset} are damaged"]

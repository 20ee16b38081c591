"""A recording that another tool rewrote is converted once: signals stay equal in bits, and a replay is identical."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType

from rtloop.errors import OutputError, RtloopError
from rtloop.interchange.export import export
from rtloop.recording.cutting.cut import cut
from rtloop.recording.errors import RecordingError
from rtloop.recording.file import conversion, layout
from rtloop.recording.file.mcap.chunks import McapSource
from rtloop.recording.file.recover import recover
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from tests.recording.real_loop import PAPER, RecordedRun, schedule
from tests.recording.rewriting import NO_INDEX, FileMessage, cut_off_end, merge, messages, write

TICKS, BURST, SNAPSHOT_TICKS = 900, 60, 150
TEXT = PAPER + schedule(
    (100, 'mode = "feedforward"'),
    (200, 'mode = "closed_loop"'),
    (400, 'reference = { kind = "sine", amplitude = 20.0, frequency_hz = 50.0 }'),
    (600, 'mode = "off"'),
    (700, 'mode = "closed_loop"'),
)


class Original(NamedTuple):
    """A recording written by rtloop, and its messages in the order of the file."""

    path: Path
    messages: list[FileMessage]

    @property
    def rows(self) -> np.ndarray:
        """Rows (ticks, columns), decoded from the messages without rtloop: doubles, each after its tag."""
        count = len(load(self.path).columns)
        fields = [field for number in range(count) for field in (
            (f"tag{number}", "u1" if number < 15 else "u2"), (str(number), "<f8"))]  # fmt: skip
        records = np.frombuffer(b"".join(message.data for message in self.topic_messages("/ticks")), fields)
        return np.column_stack([records[str(number)] for number in range(count)])

    def topic_messages(self, topic: str) -> list[FileMessage]:
        return [message for message in self.messages if message.topic == topic]

    def drop_topic(self, topic: str) -> list[FileMessage]:
        return [message for message in self.messages if message.topic != topic]


def record_chunks(path: Path, **options: float) -> list[Path]:
    """Record a short run with commands, many chunks and snapshots of the law. Returns the files."""
    run = RecordedRun(path, TEXT, paced=False, **options)
    run.loop.take_snapshots_every(SNAPSHOT_TICKS)
    while run.loop.tick < TICKS:
        run.loop.run(BURST)
        run.session.drain()
        run.session._write_all()
    return [Path(name) for name in run.end()["paths"]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Original:
    """A recording of TICKS ticks in one file, written by rtloop."""
    [path] = record_chunks(tmp_path_factory.mktemp("own") / "run.mcap")
    return Original(path, messages(path))


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three files of the same run, rotated."""
    paths = record_chunks(tmp_path_factory.mktemp("parts") / "run.mcap", rotate_s=2 * SNAPSHOT_TICKS / 10_000)
    assert len(paths) == 3
    return paths


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Path for the file that another tool writes."""
    return tmp_path / "rewritten.mcap"


def row_bytes(rows: Any) -> bytes:
    """Return the bytes of rows, to compare doubles bit for bit."""
    return np.ascontiguousarray(rows).tobytes()


def require_equal(path: Path, run: Original) -> None:
    """Require that `path` holds the whole recording in the same bits, and that a replay verifies it."""
    recording, original, summary = load(path), load(run.path), summarise(path)
    assert row_bytes(np.concatenate(list(recording.blocks()))) == row_bytes(run.rows)
    assert (recording.events, recording.header) == (original.events, original.header)
    assert [*recording.snapshots()] == [*original.snapshots()]
    report = replay(recording)
    assert (report.identical, report.ticks) == (True, TICKS), report.as_dict()
    assert (summary.complete, summary.ticks_logged, summary.problems, recording.problems) == (True, TICKS, [], [])


@pytest.mark.parametrize("ticks", ["unchanged", "json"])
@pytest.mark.parametrize("compression", CompressionType)
def test_a_file_of_the_stock_writer_is_read(run: Original, path: Path, ticks: str, compression: CompressionType):
    require_equal(write(path, run.messages, ticks=ticks, compression=compression, chunk_size=90_000), run)


NO_SUMMARY = {"index_types": NO_INDEX, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False}
LAYOUTS: dict[str, dict[str, Any]] = {
    "a chunk a message": {"chunk_size": 1},
    "one chunk": {"chunk_size": 1 << 30},
    "no chunks, foreign records": {"use_chunking": False, "foreign": True},
    "no summary": {**NO_SUMMARY, "use_summary_offsets": False},
    "no checksums": {"enable_crcs": False},
    "other numbers, foreign records": {"spare": 3, "foreign": True, "chunk_size": 50_000},
    "rtloop's own header": {"header": ("rtloop", "rtloop")},
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_any_layout_is_read(run: Original, path: Path, name: str):
    require_equal(write(path, run.messages, **LAYOUTS[name]), run)


def test_messages_in_the_order_of_time_are_read_and_cut(run: Original, path: Path, tmp_path: Path):
    write(path, sorted(run.messages, key=lambda message: message.log_time), chunk_size=20_000)
    require_equal(path, run)
    original, copy = (
        Path(cut(source, 500, 800, tmp_path / f"{i}.mcap")["output"]) for i, source in enumerate((run.path, path))
    )
    for topic in ("/ticks", "/law"):
        assert [message.data for message in Original(original, messages(original)).topic_messages(topic)] == [
            message.data for message in Original(copy, messages(copy)).topic_messages(topic)
        ]
    assert replay(load(copy)).identical


def test_a_file_is_converted_once_with_a_warning(
    run: Original, path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    require_equal(write(path, run.messages), run)
    [warning] = [record.getMessage() for record in caplog.records]
    assert warning.startswith(f"{path}: another tool wrote this recording; rtloop converts it")
    assert [*temporary.iterdir()] == []
    require_equal(write(path, run.messages, chunk_size=9_000), run)
    assert len(caplog.records) == 2


def test_the_warning_is_on_standard_error(run: Original, path: Path):
    command = [sys.executable, "-m", "rtloop", "info", write(path, run.messages), "--json"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert (result.returncode, json.loads(result.stdout)["ticks_logged"]) == (0, TICKS)
    assert result.stderr.startswith(f"{path}: another tool wrote this recording")


def test_a_full_temporary_folder_is_an_error_with_the_remedy(
    run: Original, path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuse(*_: object, **__: object) -> None:
        raise OutputError("copy.mcap.part: No space left on device", 28)

    monkeypatch.setattr(conversion, "Writer", refuse)
    with pytest.raises(
        RecordingError, match=r"rewritten\.mcap: the converted, temporary copy cannot be written .*set TMPDIR to an"
    ):
        load(write(path, run.messages))


def test_a_temporary_folder_that_does_not_exist_is_an_error_with_the_remedy(
    run: Original, path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(path.with_name("absent")))
    with pytest.raises(
        RecordingError, match=r"rewritten\.mcap: the converted, temporary copy cannot be written .*set TMPDIR to an"
    ):
        load(write(path, run.messages))


def test_a_copy_that_is_damaged_on_the_way_is_an_error_with_a_sentence(
    run: Original, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    convert, damaged = layout.open_converted_copy, tmp_path / "copy.mcap"

    def damage(source: McapSource) -> McapSource:
        with closing(convert(source)) as copy:
            data = bytearray(copy.read(0, copy.size))
        data[30:60] = bytes(30)  # within the header's record
        damaged.write_bytes(data)
        return McapSource(damaged)

    monkeypatch.setattr(layout, "open_converted_copy", damage)
    with pytest.raises(RecordingError, match=r"rewritten\.mcap: cannot be converted \(.+\); use another copy"):
        load(write(path, run.messages))


def test_a_recovered_copy_needs_no_conversion(
    run: Original, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    output = tmp_path / "recovered.mcap"
    assert recover(write(path, run.messages, ticks="json", chunk_size=1 << 30), output)["complete"]
    monkeypatch.setattr(layout, "open_converted_copy", None)
    for own_file in (output, run.path):
        require_equal(own_file, run)


TOPICS = {
    "/events": (TICKS, "'first_difference': {'tick': 100, 'signal': 'mode'"),
    "/law": (TICKS, "the recording has no tick after a snapshot of the law"),
    "/ticks": (0, "the recording has no tick after a snapshot of the law"),
}


@pytest.mark.parametrize("topic", TOPICS)
def test_a_missing_topic_is_named(run: Original, path: Path, topic: str):
    write(path, run.drop_topic(topic))
    ticks, reason = TOPICS[topic]
    assert (summarise(path).ticks_logged, export(path, "npz")["ticks"]) == (ticks, ticks)
    try:
        verdict = str(replay(load(path)).as_dict())
    except RecordingError as error:
        verdict = str(error)
    assert reason in verdict


def test_a_missing_time_span_is_not_verified(run: Original, path: Path):
    """The file is as `mcap filter --start --end` writes it, with the header."""
    span = [m for m in run.messages if m.topic == "/configuration" or 25_000_000 <= m.log_time < 75_000_000]
    recording = load(write(path, span, compression=CompressionType.LZ4))
    assert row_bytes(np.concatenate(list(recording.blocks()))) == row_bytes(run.rows[250:750])
    report = replay(recording)
    assert (report.first_difference, report.ticks) == (None, 450)  # The first snapshot of the span is at tick 300.
    assert [entry["first_tick"] for entry in report.not_verified] == [0, 250, 750]


def test_a_file_of_another_program_is_named_as_such(path: Path):
    foreign = [FileMessage(i, f"/imu{i % 20}", b'{"x": 1}', "json", None) for i in range(200)]
    write(path, [*foreign, FileMessage(9, "/\x1b[2J" + "x" * 500, b"", "", None)])
    expected = r"not a recording of rtloop; topics: '/imu0' \(json, 10 mess.*import"
    with pytest.raises(RecordingError, match=expected) as caught:
        load(path)
    message = str(caught.value)
    assert ("damaged" in message, len(message) < 700, "\x1b" in message) == (False, True, False)


def test_merged_recordings_are_refused(run: Original, parts: list[Path], path: Path):
    for paths in (parts, [run.path, parts[0]], [run.path, run.path]):
        with pytest.raises(
            RecordingError, match=r"holds several recordings, or several files of one run; .*files that were merged"
        ):
            load(write(path, merge(paths)))


def swap_blocks(run: Original) -> list[FileMessage]:
    """Return the ticks with their halves swapped, around an event that is later than all ticks and ends a block."""
    ticks, event = run.topic_messages("/ticks"), run.topic_messages("/events")[0]
    event, half = event._replace(log_time=ticks[-1].log_time + 1), len(ticks) // 2
    return [run.messages[0], *ticks[half:], event, *ticks[:half]]


def encode_as_cbor(run: Original) -> list[FileMessage]:
    """Return the messages with ticks that claim to be CBOR without a schema."""
    return [m._replace(encoding="cbor", schema=None) if m.topic == "/ticks" else m for m in run.messages]


UNREADABLE: list[tuple[Callable[[Original], list[FileMessage]], dict[str, Any], str]] = [
    (lambda run: run.drop_topic("/configuration"), {}, "the topic /configuration, .* has no message before /ticks"),
    (lambda run: [run.messages[0], *run.messages[:0:-1]], {}, "out of order: tick .*`mcap sort` sorts the messages"),
    (swap_blocks, {}, rf"out of order: tick 0 after tick {TICKS - 1}; .*`mcap sort` sorts"),
    (encode_as_cbor, {}, "/ticks are encoded as cbor, and their schema is not rtloop's; allowed: json, or protobuf"),
    (lambda run: run.messages, {"ticks": "proto3"}, "/ticks are encoded as protobuf, and their schema is not rtloop's"),
]


@pytest.mark.parametrize(("change", "options", "message"), UNREADABLE)
def test_an_unreadable_file_is_refused_with_the_remedy(
    run: Original, path: Path, change: Callable[[Original], list[FileMessage]], options: dict[str, Any], message: str
):
    with pytest.raises(RecordingError, match=message):
        load(write(path, change(run), **options))


def test_a_cut_off_file_is_refused_with_the_remedy(run: Original, path: Path):
    with pytest.raises(
        RecordingError, match=r"rewritten\.mcap: the file ends in the middle of a record; `mcap recover` keeps"
    ):
        load(cut_off_end(write(path, run.messages, chunk_size=20_000)))


def change_tick(run: Original, change: Callable[[dict[str, Any]], Any]) -> list[FileMessage]:
    """Return the messages with ticks as JSON, of which `change` changes number 40."""
    columns, rows, numbers = load(run.path).columns, run.rows, iter(range(TICKS))

    def encode(message: FileMessage) -> FileMessage:
        number = next(numbers)
        values: Any = dict(zip(columns, rows[number].tolist(), strict=True))
        data = json.dumps(change(values) if number == 40 else values).encode()
        return message._replace(encoding="json", schema=None, data=data)

    return [encode(message) if message.topic == "/ticks" else message for message in run.messages]


INVALID_TICKS: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda tick: {**tick, "mode": 7}, "mode: 7; allowed: a whole number from 0 to 3"),
    (lambda tick: {**tick, "tick": 39}, "out of order: tick 39 after 39"),
    (lambda tick: {**tick, "tick": 10**400}, "a tick in JSON cannot be read .OverflowError"),
    (lambda tick: {**tick, "deadline_ns": -1}, "deadline_ns: -1"),
    (lambda tick: {**tick, "deadline_ns": float("nan")}, "deadline_ns: nan"),
    (
        lambda tick: {**tick, "deadline_ns": tick["deadline_ns"] + 1},
        "log times of the ticks do not match their deadlines",
    ),
    (lambda tick: {key: value for key, value in tick.items() if key != "x_drive_v"}, "KeyError: 'x_drive_v'"),
    (lambda tick: {**tick, "x_drive_v": None}, "cannot be read .TypeError"),
    (lambda tick: [], "cannot be read .TypeError"),
]


@pytest.mark.parametrize(("change", "message"), INVALID_TICKS)
def test_an_invalid_tick_in_json_is_refused_by_name(run: Original, path: Path, change: Any, message: str):
    with pytest.raises(RecordingError, match=message):
        load(write(path, change_tick(run, change)))


def find_records(data: bytes) -> list[tuple[int, int]]:
    """Return (place, opcode) of all records of a file up to its data end."""
    records, position = [], 8
    while not records or records[-1][1] != 0x0F:
        opcode, length = struct.unpack_from("<BQ", data, position)
        records.append((position, opcode))
        position += 9 + length
    return records


def test_a_damaged_file_gives_an_error_or_recorded_ticks(run: Original, tmp_path: Path):
    """Bits near the beginnings of records, and anywhere, are flipped; some files are cut off."""
    random, rows = np.random.default_rng(7), {row_bytes(row) for row in run.rows}
    path, outcomes = tmp_path / "rewritten.mcap", {"refused": 0, "read": 0}
    sample = [message for place, message in enumerate(run.messages) if message.topic != "/ticks" or place % 3 == 0]
    for options in ({}, {"ticks": "json", "compression": CompressionType.LZ4}, {"spare": 1}):
        valid = write(path, sample, chunk_size=20_000, **options).read_bytes()
        starts = [position for position, _ in find_records(valid)]
        for _ in range(18):
            data = bytearray(valid)
            for _ in range(int(random.integers(1, 4))):
                near = int(random.choice(starts)) + int(random.integers(60))
                place = near if random.random() < 0.7 else int(random.integers(8, len(valid)))
                data[min(place, len(data) - 1)] ^= 1 << int(random.integers(8))
            path.write_bytes(data[: len(data) if random.random() < 0.7 else int(random.integers(8, len(data)))])
            try:
                recording = load(path)
                blocks = [*recording.blocks()]
                [*recording.snapshots()]
            except RtloopError as error:
                outcomes["refused"] += str(path) in str(error)
                continue
            assert all(row_bytes(row) in rows for block in blocks for row in block)
            outcomes["read"] += 1
    assert min(outcomes.values()) > 3, outcomes


def chunk_record(content: bytes, name: str, *, size: int | None = None, data: bytes | None = None) -> bytes:
    """Pack a chunk record without a checksum; `size` and `data` may contradict its content."""
    data = content if data is None else data
    size = len(content) if size is None else size
    body = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name.encode() + struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


def oversized_files(valid: bytes) -> dict[str, bytes]:
    """Return files by name, each with an additional record whose lengths claim much memory."""
    end, zeros = find_records(valid)[-1][0], bytes(1 << 28)
    records = {
        "zstd that grows": chunk_record(b"", "zstd", size=1 << 20, data=zstandard.ZstdCompressor().compress(zeros)),
        "lz4 that grows": chunk_record(b"", "lz4", size=1 << 20, data=lz4.frame.compress(zeros)),
        "a size of 2^62": chunk_record(b"", "zstd", size=1 << 62, data=zstandard.ZstdCompressor().compress(b"x")),
        "a size of 1 GiB": chunk_record(b"", "", size=1 << 30),
        "another compression": chunk_record(b"x", "brotli"),
        "a message of 2^60 bytes": b"\x05" + struct.pack("<Q", 1 << 60),
        "a name of 4 GiB": b"\x06" + struct.pack("<QQQQII", 60, 0, 0, 9, 0, (1 << 32) - 1) + bytes(60 - 32),
        "a channel of 4 GiB": b"\x04" + struct.pack("<QHHI", 30, 7, 0, (1 << 32) - 1) + bytes(22),
        "an attachment of 2 GiB": b"\x09" + struct.pack("<Q", 2 << 30),
        "a message of no channel": b"\x05" + struct.pack("<QHIQQ", 22 + 200_000, 99, 0, 0, 0) + b"[" * 200_000,
    }
    return {name: valid[:end] + record + valid[end:] for name, record in records.items()}


def test_a_length_in_a_file_does_not_allocate_memory(run: Original, tmp_path: Path):
    path = tmp_path / "rewritten.mcap"
    valid = write(path, run.messages, chunk_size=50_000).read_bytes()
    for name, data in oversized_files(valid).items():
        path.write_bytes(data)
        tracemalloc.start()
        try:
            with pytest.raises(RecordingError, match=r"rewritten\.mcap: .*`mcap recover`"):
                load(path)
            assert tracemalloc.get_traced_memory()[1] < 80 << 20, name
        finally:
            tracemalloc.stop()

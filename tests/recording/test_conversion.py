"""A recording that another tool wrote anew is converted once: signals stay equal in bits, and a replay is identical."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType

from rtloop.errors import OutputError, RtloopError
from rtloop.interchange.export import export
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.cutting.cut import cut
from rtloop.recording.errors import RecordingError
from rtloop.recording.file import conversion, layout
from rtloop.recording.file.recover import recover
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from tests.recording.real_loop import PAPER, RealLoop
from tests.recording.rewriting import NO_INDEX, Said, merged, messages, without_end, write

TICKS, BURST, SNAPSHOT_TICKS = 900, 60, 150
SCHEDULE = (
    (100, 'mode = "feedforward"'),
    (200, 'mode = "closed_loop"'),
    (400, 'reference = { kind = "sine", amplitude = 20.0, frequency_hz = 50.0 }'),
    (600, 'mode = "off"'),
    (700, 'mode = "closed_loop"'),
)
Rng = np.random.default_rng


class Run(NamedTuple):
    """A recording of rtloop's own, and its messages in the order of the file."""

    path: Path
    said: list[Said]

    @property
    def rows(self) -> np.ndarray:
        """All ticks, by the stock library: each is 31 bytes of head less than a record, doubles behind their tags."""
        columns = load(self.path).columns
        fields = [field for number in range(len(columns)) for field in (
            (f"tag{number}", "u1" if number < 15 else "u2"), (str(number), "<f8"))]  # fmt: skip
        found = np.frombuffer(b"".join(one.data for one in self.said if one.topic == "/ticks"), fields)
        return np.column_stack([found[str(number)] for number in range(len(columns))])


def recorded(path: Path, **options: float) -> list[Path]:
    """The files of a short run with commands, many chunks and snapshots of the law."""
    text = PAPER + "".join(f"\n[[schedule]]\nat_tick = {tick}\n{what}\n" for tick, what in SCHEDULE)
    loop = RealLoop(text)
    loop.take_snapshots_every(SNAPSHOT_TICKS)
    session = Session(loop.block, path, loop.header, Options(min_free_bytes=0, **options))  # type: ignore[arg-type]
    while loop.tick < TICKS:
        loop.run(BURST)
        session.drain()
        session._write_all()
    return [Path(one) for one in session.finish("finished")["paths"]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    [path] = recorded(tmp_path_factory.mktemp("own") / "run.mcap")
    return Run(path, messages(path))


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The same in three files."""
    found = recorded(tmp_path_factory.mktemp("parts") / "run.mcap", rotate_s=2 * SNAPSHOT_TICKS / 10_000)
    assert len(found) == 3
    return found


def bits(rows: Any) -> bytes:
    return np.ascontiguousarray(rows).tobytes()


def require_same(path: Path, run: Run) -> None:
    """All that is in the recording is in `path`, in the same bits, and a replay verifies it."""
    found, own = load(path), load(run.path)
    assert bits(np.concatenate(list(found.blocks()))) == bits(run.rows)
    assert found.events == own.events
    assert [*found.snapshots()] == [*own.snapshots()]
    assert found.header == own.header
    report = replay(found)
    assert report.identical, report.as_dict()
    assert report.ticks == TICKS
    said = summarise(path)
    assert (said.complete, said.ticks_logged, said.problems, found.problems) == (True, TICKS, [], [])


@pytest.mark.parametrize("ticks", ["as it is", "json"])
@pytest.mark.parametrize("compression", CompressionType)
def test_the_stock_writer(run: Run, tmp_path: Path, ticks: str, compression: CompressionType):
    require_same(write(tmp_path / "anew.mcap", run.said, ticks=ticks, compression=compression, chunk_size=90_000), run)


BARE = {"index_types": NO_INDEX, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False}
LAYOUTS: dict[str, dict[str, Any]] = {
    "a chunk a message": {"chunk_size": 1},
    "one chunk": {"chunk_size": 1 << 30},
    "no chunks, others between": {"use_chunking": False, "beside": True},
    "no summary": {**BARE, "use_summary_offsets": False},
    "no checksums": {"enable_crcs": False},
    "other numbers, others between": {"spare": 3, "beside": True, "chunk_size": 50_000},
    "rtloop's own header": {"header": ("rtloop", "rtloop")},
}


@pytest.mark.parametrize("how", LAYOUTS)
def test_however_it_is_laid_out(run: Run, tmp_path: Path, how: str):
    require_same(write(tmp_path / "anew.mcap", run.said, **LAYOUTS[how]), run)


def test_in_the_order_of_time(run: Run, tmp_path: Path):
    said = sorted(run.said, key=lambda one: one.log_time)
    path = write(tmp_path / "anew.mcap", said, chunk_size=20_000)
    require_same(path, run)
    found = [cut(one, 500, 800, tmp_path / f"{i}.mcap") for i, one in enumerate((run.path, path))]
    own, other = (messages(Path(one["output"])) for one in found)
    for topic in ("/ticks", "/law"):
        assert [one.data for one in own if one.topic == topic] == [one.data for one in other if one.topic == topic]
    assert replay(load(found[1]["output"])).identical


def test_it_is_converted_once_and_that_is_said(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    path = write(tmp_path / "anew.mcap", run.said)
    require_same(path, run)
    [said] = [one.getMessage() for one in caplog.records]
    assert said.startswith(f"{path}: another tool wrote this recording; it is converted")
    assert [*(tmp_path / "temporary").iterdir()] == []
    write(path, run.said, chunk_size=9_000)
    require_same(path, run)
    assert len(caplog.records) == 2


def test_it_is_said_on_standard_error(run: Run, tmp_path: Path):
    path = write(tmp_path / "anew.mcap", run.said)
    done = subprocess.run([sys.executable, "-m", "rtloop", "info", path, "--json"], capture_output=True, text=True)
    assert done.returncode == 0
    assert json.loads(done.stdout)["ticks_logged"] == TICKS
    assert done.stderr.startswith(f"{path}: another tool wrote this recording")


def test_a_full_temporary_folder_is_an_error_with_the_remedy(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object, **__: object) -> None:
        raise OutputError("copy.mcap.part: No space left on device", 28)

    monkeypatch.setattr(conversion, "Writer", refuse)
    with pytest.raises(RecordingError, match=r"anew\.mcap: no room to convert it .*set TMPDIR to another folder"):
        load(write(tmp_path / "anew.mcap", run.said))


def test_recovered_it_is_one_of_rtloops_own(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write(tmp_path / "anew.mcap", run.said, ticks="json", chunk_size=1 << 30)
    output = tmp_path / "recovered.mcap"
    assert recover(path, output)["complete"]
    monkeypatch.setattr(layout, "open_converted_copy", None)
    require_same(output, run)


def test_rtloops_own_files_are_not_gone_through(run: Run, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(layout, "open_converted_copy", None)
    require_same(run.path, run)


def test_a_file_without_its_end_is_refused_with_the_remedy(run: Run, tmp_path: Path):
    path = without_end(write(tmp_path / "anew.mcap", run.said, chunk_size=20_000))
    with pytest.raises(RecordingError, match=r"anew\.mcap: it ends in the middle of a record; `mcap recover` keeps"):
        load(path)


WITHOUT = {
    "/events": (TICKS, "'first_difference': {'tick': 100, 'signal': 'mode'"),
    "/law": (TICKS, "no tick after a snapshot of the law"),
    "/ticks": (0, "no tick after a snapshot of the law"),
}


@pytest.mark.parametrize("topic", WITHOUT)
def test_a_topic_filtered_away(run: Run, tmp_path: Path, topic: str):
    path = write(tmp_path / "anew.mcap", [one for one in run.said if one.topic != topic])
    ticks, why = WITHOUT[topic]
    said = summarise(path)
    assert said.ticks_logged == ticks
    assert export(path, "npz")["ticks"] == ticks
    try:
        verdict = str(replay(load(path)).as_dict())
    except RecordingError as error:
        verdict = str(error)
    assert why in verdict


def test_a_stretch_of_time_filtered_out(run: Run, tmp_path: Path):
    """`mcap filter --start --end`, with the header kept: what is there is identical, and what is not is said."""
    kept = [one for one in run.said if one.topic == "/configuration" or 25_000_000 <= one.log_time < 75_000_000]
    path = write(tmp_path / "anew.mcap", kept, compression=CompressionType.LZ4)
    assert bits(np.concatenate(list(load(path).blocks()))) == bits(run.rows[250:750])
    report = replay(load(path))
    assert report.first_difference is None
    assert report.ticks == 450  # the state of the law at tick 300 is the first that was kept
    assert [one["first_tick"] for one in report.not_verified] == [0, 250, 750]


def test_without_its_header_it_says_what_is_missing(run: Run, tmp_path: Path):
    path = write(tmp_path / "anew.mcap", [one for one in run.said if one.topic != "/configuration"])
    with pytest.raises(RecordingError, match=r"without its topic /configuration in front of /ticks"):
        load(path)


def test_a_file_of_somebody_else_is_called_that(tmp_path: Path):
    said = [Said(i, f"/imu{i % 20}", b'{"x": 1}', "json", None) for i in range(200)]
    path = write(tmp_path / "imu.mcap", [*said, Said(9, "/\x1b[2J" + "x" * 500, b"", "", None)])
    with pytest.raises(
        RecordingError, match=r"not a recording of rtloop: it holds '/imu0' \(json, 10 mess.*import"
    ) as it:
        load(path)
    assert "damaged" not in str(it.value)
    assert len(str(it.value)) < 700
    assert "\x1b" not in str(it.value)


def test_merged_recordings_are_refused(run: Run, parts: list[Path], tmp_path: Path):
    for paths in (parts, [run.path, parts[0]], [run.path, run.path]):
        with pytest.raises(RecordingError, match=r"holds several recordings or parts of one; .*merged from"):
            load(write(tmp_path / "merged.mcap", merged(paths)))


def test_ticks_in_no_order_are_refused_with_the_remedy(run: Run, tmp_path: Path):
    begin, *others = run.said
    with pytest.raises(RecordingError, match=r"out of order: tick .*`mcap sort` puts it in order"):
        load(write(tmp_path / "anew.mcap", [begin, *others[::-1]]))


def test_blocks_of_ticks_that_are_ordered_within_alone_are_refused(run: Run, tmp_path: Path):
    """An event between the blocks, later than all ticks, ends the first of them."""
    begin, *others = run.said
    ticks = [message for message in others if message.topic == "/ticks"]
    event = next(message for message in others if message.topic == "/events")
    event = event._replace(log_time=ticks[-1].log_time + 1)
    half = len(ticks) // 2
    with pytest.raises(RecordingError, match=rf"out of order: tick 0 after {len(ticks) - 1}; .*`mcap sort` puts"):
        load(write(tmp_path / "anew.mcap", [begin, *ticks[half:], event, *ticks[:half]]))


def test_ticks_in_an_encoding_that_cannot_be_read(run: Run, tmp_path: Path):
    said = [one._replace(encoding="cbor", schema=None) if one.topic == "/ticks" else one for one in run.said]
    with pytest.raises(RecordingError, match=r"/ticks: its messages are cbor of another schema; allowed: protobuf"):
        load(write(tmp_path / "anew.mcap", said))
    with pytest.raises(RecordingError, match=r"/ticks: its messages are protobuf of another schema"):
        load(write(tmp_path / "anew.mcap", run.said, ticks="proto3"))


def with_tick(run: Run, change: Callable[[dict[str, Any]], Any]) -> list[Said]:
    """The ticks in JSON, the fortieth changed."""
    columns, rows = load(run.path).columns, run.rows
    ticks = iter(range(TICKS))

    def encoded(one: Said) -> Said:
        number = next(ticks)
        values: Any = dict(zip(columns, rows[number].tolist(), strict=True))
        changed = change(values) if number == 40 else values
        return one._replace(encoding="json", schema=None, data=json.dumps(changed).encode())

    return [encoded(one) if one.topic == "/ticks" else one for one in run.said]


FALSE: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda tick: {**tick, "mode": 7}, "mode: 7; a whole number from 0 to 3"),
    (lambda tick: {**tick, "tick": 39}, "out of order: tick 39 after 39"),
    (lambda tick: {**tick, "tick": 10**400}, "a tick in JSON cannot be read .OverflowError"),
    (lambda tick: {**tick, "deadline_ns": -1}, "deadline_ns: -1"),
    (lambda tick: {**tick, "deadline_ns": float("nan")}, "deadline_ns: nan"),
    (lambda tick: {**tick, "deadline_ns": tick["deadline_ns"] + 1}, "its log times contradict its deadlines"),
    (lambda tick: {key: value for key, value in tick.items() if key != "x_drive_v"}, "KeyError: 'x_drive_v'"),
    (lambda tick: {**tick, "x_drive_v": None}, "cannot be read .TypeError"),
    (lambda tick: [], "cannot be read .TypeError"),
]


@pytest.mark.parametrize(("change", "why"), FALSE)
def test_a_tick_in_json_that_is_none_is_refused_by_name(run: Run, tmp_path: Path, change: Any, why: str):
    with pytest.raises(RecordingError, match=why):
        load(write(tmp_path / "anew.mcap", with_tick(run, change)))


def records_of(data: bytes) -> list[tuple[int, int]]:
    """Place and opcode of all records of a file up to its data end."""
    found, position = [], 8
    while not found or found[-1][1] != 0x0F:
        opcode, length = struct.unpack_from("<BQ", data, position)
        found.append((position, opcode))
        position += 9 + length
    return found


def test_nothing_that_was_changed_is_taken_for_what_was_recorded(run: Run, tmp_path: Path):
    """Every kind of record cut, lengthened and flipped: an error in words, or what was recorded."""
    random, rows = Rng(7), {bits(row) for row in run.rows}
    path, outcomes = tmp_path / "anew.mcap", {"refused": 0, "all": 0}
    for ticks, options in (
        ("as it is", {}),
        ("json", {"compression": CompressionType.LZ4}),
        ("as it is", {"spare": 1}),
    ):
        said = [one for place, one in enumerate(run.said) if one.topic != "/ticks" or place % 3 == 0]
        good = write(path, said, ticks=ticks, chunk_size=20_000, **options).read_bytes()
        starts = [position for position, _ in records_of(good)]
        for _ in range(18):
            data = bytearray(good)
            for _ in range(int(random.integers(1, 4))):
                near = int(random.choice(starts)) + int(random.integers(60))
                place = near if random.random() < 0.7 else int(random.integers(8, len(good)))
                data[min(place, len(data) - 1)] ^= 1 << int(random.integers(8))
            path.write_bytes(data[: len(data) if random.random() < 0.7 else int(random.integers(8, len(data)))])
            try:
                found = load(path)
                blocks = [*found.blocks()]
                [*found.snapshots()]
            except RtloopError as error:
                outcomes["refused"] += str(path) in str(error)
                continue
            assert all(bits(row) in rows for block in blocks for row in block)
            outcomes["all"] += 1
    assert min(outcomes.values()) > 3, outcomes


def chunk(content: bytes, name: str, *, size: int | None = None, data: bytes | None = None) -> bytes:
    """A chunk record without a checksum."""
    data = content if data is None else data
    size = len(content) if size is None else size
    body = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name.encode() + struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


def message(number: int, payload: bytes) -> bytes:
    return b"\x05" + struct.pack("<QHIQQ", 22 + len(payload), number, 0, 0, 0) + payload


def bombs(good: bytes) -> dict[str, bytes]:
    """Files that ask for much memory: what stands in front of the data end is put between the rest."""
    end = records_of(good)[-1][0]
    zeros = bytes(1 << 28)
    made = {
        "zstd that grows": chunk(b"", "zstd", size=1 << 20, data=zstandard.ZstdCompressor().compress(zeros)),
        "lz4 that grows": chunk(b"", "lz4", size=1 << 20, data=lz4.frame.compress(zeros)),
        "a size of 2^62": chunk(b"", "zstd", size=1 << 62, data=zstandard.ZstdCompressor().compress(b"x")),
        "a size of 1 GiB": chunk(b"", "", size=1 << 30),
        "another compression": chunk(b"x", "brotli"),
        "a message of 2^60 bytes": b"\x05" + struct.pack("<Q", 1 << 60),
        "a name of 4 GiB": b"\x06" + struct.pack("<QQQQII", 60, 0, 0, 9, 0, (1 << 32) - 1) + bytes(60 - 32),
        "a channel of 4 GiB": b"\x04" + struct.pack("<QHHI", 30, 7, 0, (1 << 32) - 1) + bytes(22),
        "an attachment of 2 GiB": b"\x09" + struct.pack("<Q", 2 << 30),
        "a message of no channel": message(99, b"[" * 200_000),
    }
    return {name: good[:end] + one + good[end:] for name, one in made.items()}


def test_no_length_is_believed(run: Run, tmp_path: Path):
    path = tmp_path / "anew.mcap"
    good = write(path, run.said, chunk_size=50_000).read_bytes()
    for name, data in bombs(good).items():
        path.write_bytes(data)
        tracemalloc.start()
        try:
            with pytest.raises(RecordingError, match=r"anew\.mcap: .*`mcap recover`"):
                load(path)
            assert tracemalloc.get_traced_memory()[1] < 80 << 20, name
        finally:
            tracemalloc.stop()

"""A recording that another tool wrote anew says what it said before: to every view, to a replay, and bit for bit."""

from __future__ import annotations

import json
import re
import struct
import tracemalloc
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType
from mcap_protobuf.schema import build_file_descriptor_set

from rtloop.errors import RtloopError
from rtloop.interchange.export import export
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.cutting.cut import cut
from rtloop.recording.errors import RecordingError
from rtloop.recording.file import layout
from rtloop.recording.file.recover import recover
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.plot import plot
from rtloop.recording.views.summary import summarise
from tests.recording.real_loop import PAPER, RealLoop
from tests.recording.rewriting import NO_INDEX, Said, backwards, merged, messages, without_end, write

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


STOCK = [(ticks, way) for ticks in ("as it is", "json", "protobuf") for way in CompressionType]


@pytest.mark.parametrize(("ticks", "compression"), STOCK)
def test_the_stock_writer(run: Run, tmp_path: Path, ticks: str, compression: CompressionType):
    path = write(tmp_path / "anew.mcap", run.said, ticks=ticks, compression=compression)
    require_same(path, run)
    csv = [Path(export(one, "csv", tmp_path / f"{i}.csv")["output"]) for i, one in enumerate((path, run.path))]
    assert csv[0].read_bytes() == csv[1].read_bytes()


def test_a_picture_of_it(run: Run, tmp_path: Path):
    path = write(tmp_path / "anew.mcap", run.said, ticks="json", compression=CompressionType.LZ4)
    picture = plot(path, tmp_path / "anew.png", start_s=0.02, end_s=0.08)
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert picture.stat().st_size > 50_000


BARE = {"index_types": NO_INDEX, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False}
LAYOUTS: dict[str, dict[str, Any]] = {
    "a chunk a message": {"chunk_size": 1},
    "small chunks, lz4": {"chunk_size": 5_000, "compression": CompressionType.LZ4},
    "one chunk": {"chunk_size": 1 << 30},
    "no chunks": {"use_chunking": False},
    "no chunks, others between": {"use_chunking": False, "beside": True},
    "no summary": {**BARE, "use_summary_offsets": False},
    "no checksums": {"enable_crcs": False},
    "other numbers, others between": {"spare": 3, "beside": True, "chunk_size": 50_000},
    "rtloop's own header": {"header": ("rtloop", "rtloop")},
    "proto3, other field numbers": {"ticks": "proto3"},
    "proto2, other field numbers": {"ticks": "proto2"},
}


@pytest.mark.parametrize("how", LAYOUTS)
def test_however_it_is_laid_out(run: Run, tmp_path: Path, how: str):
    require_same(write(tmp_path / "anew.mcap", run.said, **LAYOUTS[how]), run)


def by_topic(said: list[Said]) -> list[Said]:
    return sorted(said, key=lambda one: one.topic)


ORDERS: dict[str, Callable[[list[Said]], list[Said]]] = {
    "by time": lambda said: sorted(said, key=lambda one: one.log_time),
    "by topic": by_topic,
    "the law first, ticks last": lambda said: by_topic(said)[::-1],
    "backwards": lambda said: said[::-1],
    "anyhow": lambda said: [said[place] for place in Rng(1).permutation(len(said))],
}


@pytest.mark.parametrize("chunk_size", [60_000, 1 << 20])
@pytest.mark.parametrize("how", ORDERS)
def test_in_whatever_order(run: Run, tmp_path: Path, how: str, chunk_size: int, monkeypatch: pytest.MonkeyPatch):
    if chunk_size < 1 << 20 and how != "anyhow":  # each chunk is taken by itself; but for that it needs its order
        monkeypatch.setattr("rtloop.recording.file.foreign.stretches.STRETCH_BYTES", 1)
    path = write(tmp_path / "anew.mcap", ORDERS[how](run.said), chunk_size=chunk_size)
    require_same(path, run)
    found = [cut(one, 500, 800, tmp_path / f"{i}.mcap") for i, one in enumerate((run.path, path))]
    own, other = (messages(Path(one["output"])) for one in found)
    for topic in ("/ticks", "/law"):
        assert [one.data for one in own if one.topic == topic] == [one.data for one in other if one.topic == topic]
    assert found[1]["complete"]
    report = replay(load(found[1]["output"]))
    assert (report.identical, report.ticks) == (True, 350)


def test_ticks_in_no_order_are_refused_with_what_puts_them_in_order(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("rtloop.recording.file.foreign.stretches.STRETCH_BYTES", 1)
    path = write(tmp_path / "anew.mcap", ORDERS["anyhow"](run.said), chunk_size=20_000)
    with pytest.raises(RecordingError, match=r"in no order.*`mcap sort`"):
        load(path)


def test_recovered_it_is_one_of_rtloops_own(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write(tmp_path / "anew.mcap", run.said, ticks="json", chunk_size=1 << 30)
    output = tmp_path / "recovered.mcap"
    assert recover(path, output)["complete"]
    monkeypatch.setattr(layout, "Rewritten", None)
    require_same(output, run)


def test_rtloops_own_files_are_not_gone_through(run: Run, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(layout, "Rewritten", None)
    require_same(run.path, run)


def test_a_file_without_its_end(run: Run, tmp_path: Path):
    whole = write(tmp_path / "anew.mcap", run.said, chunk_size=20_000)
    assert replay(load(without_end(whole))).identical
    data = whole.read_bytes()
    whole.write_bytes(data[: len(data) // 2])
    found = load(whole)
    rows = np.concatenate(list(found.blocks()))
    assert 0 < len(rows) < TICKS
    assert bits(rows) == bits(run.rows[: len(rows)])
    assert "it ends in the middle of a record" in found.problems[0]
    assert not summarise(whole).complete
    assert not replay(found).identical


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
    with pytest.raises(RecordingError, match=r"without its topic /configuration.*'/ticks' \(protobuf, 900 messages\)"):
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


def test_parts_merged_are_one_recording(parts: list[Path], tmp_path: Path):
    path = write(tmp_path / "merged.mcap", merged(parts[::-1]), chunk_size=70_000)
    found, own = load(path), load(parts)
    assert bits(np.concatenate(list(found.blocks()))) == bits(np.concatenate(list(own.blocks())))
    assert [*found.snapshots()] == [*own.snapshots()]
    assert found.events[:-1] == [one for one in own.events if one["kind"] not in ("rotated", "finished")]
    assert found.events[-1]["what"]["ticks_logged"] == TICKS
    assert replay(found).identical
    said = summarise(path)
    assert (said.complete, said.ticks_logged, said.ticks_lost, said.result) == (True, TICKS, 0, "finished")
    assert recover(path, tmp_path / "one.mcap")["complete"]
    assert summarise(tmp_path / "one.mcap").complete


def test_a_part_that_was_not_merged_is_missed(parts: list[Path], tmp_path: Path):
    path = write(tmp_path / "merged.mcap", merged([parts[0], parts[2]]))
    assert load(path).problems == ["part 2 of the run is missing"]
    assert [one["first_tick"] for one in replay(load(path)).not_verified] == [300]
    assert not summarise(path).complete


def test_the_last_part_is_unfinished(parts: list[Path], tmp_path: Path):
    said = [one for one in merged(parts[:2]) if (one.file, one.topic) != (1, "/events")]
    path = write(tmp_path / "merged.mcap", said)
    assert "states no end" in str(replay(load(path)).as_dict())


def test_two_runs_merged_are_refused(run: Run, parts: list[Path], tmp_path: Path):
    path = write(tmp_path / "merged.mcap", merged([run.path, parts[0]]))
    with pytest.raises(RecordingError, match=r"holds 2 runs, 'test' of \d{4}-.* each by itself"):
        load(path)
    with pytest.raises(RecordingError, match="part of the run twice"):
        load(write(tmp_path / "twice.mcap", merged([run.path, run.path])))


def test_ticks_in_an_encoding_that_cannot_be_read(run: Run, tmp_path: Path):
    said = [one._replace(encoding="cbor", schema=None) if one.topic == "/ticks" else one for one in run.said]
    with pytest.raises(RecordingError, match=r"/ticks: its messages are cbor; json, protobuf"):
        load(write(tmp_path / "anew.mcap", said))


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
    (lambda tick: {**tick, "tick": 1e300}, r"tick: 1e\+300"),
    (lambda tick: {**tick, "tick": 39}, "out of order: tick 39 after 39"),
    (lambda tick: {**tick, "tick": 10**400}, "a whole number in it is too large"),
    (lambda tick: {**tick, "deadline_ns": -1}, "deadline_ns: -1"),
    (lambda tick: {**tick, "deadline_ns": "NaN"}, "deadline_ns: nan"),
    (lambda tick: {key: value for key, value in tick.items() if key != "x_drive_v"}, "it has no x_drive_v"),
    (lambda tick: {**tick, "x_drive_v": "5"}, "it has no x_drive_v"),
    (lambda tick: [], "it has no tick"),
    (lambda tick: {**tick, "a": [[0] * 50] * 50}, "more than 2000 fields"),
]


@pytest.mark.parametrize(("change", "why"), FALSE)
def test_a_tick_in_json_that_is_none_is_left_out_by_name(run: Run, tmp_path: Path, change: Any, why: str):
    found = load(write(tmp_path / "anew.mcap", with_tick(run, change)))
    assert len(found) == 0
    [problem] = found.left_out
    assert re.search(why, problem), problem


def records_of(data: bytes) -> list[tuple[int, int]]:
    """Place and opcode of all records of a file up to its data end."""
    found, position = [], 8
    while not found or found[-1][1] != 0x0F:
        opcode, length = struct.unpack_from("<BQ", data, position)
        found.append((position, opcode))
        position += 9 + length
    return found


def test_nothing_that_was_changed_is_taken_for_what_was_recorded(run: Run, tmp_path: Path):
    """Every kind of record cut, lengthened and flipped: an error in words, or a part of what was recorded."""
    random, rows = Rng(7), {bits(row) for row in run.rows}
    path, outcomes = tmp_path / "anew.mcap", {"refused": 0, "a part": 0, "all": 0}
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
            whole = sum(map(len, blocks)) == sum(one.topic == "/ticks" for one in said)
            outcomes["all" if whole else "a part"] += 1
    assert min(outcomes.values()) > 3, outcomes


def chunk(content: bytes, name: str, *, size: int | None = None, data: bytes | None = None) -> bytes:
    """A chunk record without a checksum."""
    data = content if data is None else data
    size = len(content) if size is None else size
    body = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name.encode() + struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def channel(number: int, topic: bytes, encoding: bytes = b"json", schema: int = 0) -> bytes:
    body = struct.pack("<HH", number, schema) + text(topic) + text(encoding) + bytes(4)
    return b"\x04" + struct.pack("<Q", len(body)) + body


def ticks_of_nothing(columns: Sequence[str]) -> bytes:
    """Many messages without a byte, each of which stands for a tick of zeros."""
    kind = backwards(columns, "proto3")
    data = build_file_descriptor_set(kind).SerializeToString()
    body = struct.pack("<H", 98) + text(b"another.Sample") + text(b"protobuf") + text(data)
    schema = b"\x03" + struct.pack("<Q", len(body)) + body
    return schema + channel(98, b"/ticks", b"protobuf", 98) + message(98, b"") * 150_000


def message(number: int, payload: bytes) -> bytes:
    return b"\x05" + struct.pack("<QHIQQ", 22 + len(payload), number, 0, 0, 0) + payload


def bombs(good: bytes, columns: Sequence[str]) -> dict[str, bytes]:
    """Files that ask for much memory: what stands in front of the data end is put between the rest."""
    end = records_of(good)[-1][0]
    zeros = bytes(1 << 28)
    nested, empty = channel(99, b"/b") + message(99, b"[" * 200_000), ticks_of_nothing(columns)
    made = {
        "zstd that grows": chunk(b"", "zstd", size=1 << 20, data=zstandard.ZstdCompressor().compress(zeros)),
        "lz4 that grows": chunk(b"", "lz4", size=1 << 20, data=lz4.frame.compress(zeros)),
        "a size of 2^62": chunk(b"", "zstd", size=1 << 62, data=zstandard.ZstdCompressor().compress(b"x")),
        "a size of 1 GiB": chunk(b"", "", size=1 << 30),
        "a message of 2^60 bytes": b"\x05" + struct.pack("<Q", 1 << 60),
        "a name of 4 GiB": b"\x06" + struct.pack("<QQQQII", 60, 0, 0, 9, 0, (1 << 32) - 1) + bytes(60 - 32),
        "a channel of 4 GiB": b"\x04" + struct.pack("<QHHI", 30, 7, 0, (1 << 32) - 1) + bytes(22),
        "deep JSON": nested,
        "many ticks of no byte": chunk(empty, "zstd", data=zstandard.ZstdCompressor().compress(empty)),
    }
    return {name: good[:end] + one + good[end:] for name, one in made.items()}


def test_no_length_is_believed(run: Run, tmp_path: Path):
    path = tmp_path / "anew.mcap"
    good = write(path, run.said, chunk_size=50_000).read_bytes()
    for name, data in bombs(good, load(run.path).columns).items():
        path.write_bytes(data)
        tracemalloc.start()
        try:
            found = load(path)
            assert bits(np.concatenate(list(found.blocks()))) == bits(run.rows), name
            assert found.problems or name == "deep JSON", name
            assert name != "many ticks of no byte" or "take more than 32 MiB" in found.problems[0]
            assert tracemalloc.get_traced_memory()[1] < 80 << 20, name
        finally:
            tracemalloc.stop()


@pytest.mark.parametrize(("opcode", "said"), [(9, []), (5, ["at most 32 MiB can be read"])])
def test_two_gigabytes_of_nothing(run: Run, tmp_path: Path, opcode: int, said: list[str]):
    """An attachment, and a message, in a file with a hole."""
    path = write(tmp_path / "anew.mcap", run.said)
    data = path.read_bytes()
    end = records_of(data)[-1][0]
    with path.open("r+b") as file:
        file.seek(end)
        file.write(struct.pack("<BQ", opcode, 2 << 30))
        file.seek(end + 9 + (2 << 30))
        file.write(data[end:])
    tracemalloc.start()
    try:
        found = load(path)
        assert bits(np.concatenate(list(found.blocks()))) == bits(run.rows)
        assert tracemalloc.get_traced_memory()[1] < 60 << 20
    finally:
        tracemalloc.stop()
    assert [problem.partition("; ")[2] for problem in found.problems] == said


def test_runs_of_equal_messages_are_split_where_they_differ():
    """The one place that looks at many messages at once, against a reader that takes one after the other."""
    from rtloop.recording.file.foreign.stretches import Topics, runs

    random = Rng(3)
    topics = Topics()
    topics.channels = dict.fromkeys(range(4))  # type: ignore[arg-type]
    for _ in range(30):
        kinds = np.repeat(random.integers(0, 8, 12), random.integers(1, 90, 12))
        said = [(int(kind) % 4, i, bytes([i % 251]) * (5 + int(kind) // 4)) for i, kind in enumerate(kinds)]
        data = b"".join(
            b"\x05" + struct.pack("<QHIQQ", 22 + len(one), channel, 7, time, 0) + one for channel, time, one in said
        )
        found = [*runs(memoryview(data), topics)]
        assert [
            (run.channel, int(time), payload)
            for run in found
            for time, payload in zip(run.log_times, run.payloads, strict=True)
        ] == said
        same = groupby(said, key=lambda one: (one[0], len(one[2])))
        assert len(found) == sum(1 for _ in same)

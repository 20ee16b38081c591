"""The file: the public MCAP and protobuf libraries read the numbers that were written."""

from __future__ import annotations

import hashlib
import json
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import MessageIndex
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from rtloop.errors import OutputError
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.topics.format import TICKS, chunk_rows, tick_dtype, tick_schema
from rtloop.recording.file.writer import Writer
from rtloop.signals import DRIVER_STATUS, FLAGS, MODE, PERIODS_MISSED, column_names
from tests.recording.hand_made_loop import (
    COLUMNS,
    START_UNIX_NS,
    final_message,
    make_header,
    make_rows,
    snapshot,
    write_recording,
)

COUNT = 3_000
SPECIAL = (
    *(0.0, -0.0, np.nan, -np.nan, np.inf, -np.inf),
    *(5e-324, -5e-324, 2.2250738585072014e-308, 1.7976931348623157e308),
)


@pytest.fixture(scope="module")
def rows() -> np.ndarray:
    """Rows with signed zeros, NaN, infinities, and the smallest and largest doubles."""
    rows = make_rows(COUNT)
    rows[: len(SPECIAL), 12:] = np.array(SPECIAL)[:, None]
    return rows


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, rows: np.ndarray) -> Path:
    """A recording that holds `rows`."""
    return write_recording(tmp_path_factory.mktemp("file") / "run.mcap", rows)


def stock_rows(path: Path, names: tuple[str, ...] = COLUMNS) -> np.ndarray:
    """Return the rows (ticks, columns) of a recording, by the public libraries."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = [row.decoded_message for row in reader.iter_decoded_messages(topics=["/ticks"])]
    return np.array([[getattr(message, name) for name in names] for message in decoded])


def read_rows(path: Path) -> np.ndarray:
    """Return the rows (ticks, columns) of a recording, by rtloop's reader."""
    with Reader(path) as reader:
        return np.concatenate(list(reader.blocks()))


def test_every_field_is_present_even_where_it_is_zero(path: Path):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        message = next(iter(reader.iter_decoded_messages(topics=["/ticks"]))).decoded_message
    assert [field.name for field, _ in message.ListFields()] == list(COLUMNS)
    assert all(message.HasField(name) for name in COLUMNS)


def test_both_readers_give_the_written_numbers(path: Path, rows: np.ndarray):
    assert stock_rows(path).tobytes() == read_rows(path).tobytes() == rows.tobytes()
    with Reader(path) as reader:
        selection = np.concatenate(list(reader.blocks(["x_drive_v", "tick"])))
    assert selection.tobytes() == rows[:, [COLUMNS.index("x_drive_v"), 0]].tobytes()


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=arrays(np.float64, (5, len(COLUMNS) - 2), elements=st.floats(allow_subnormal=True)))
def test_any_double_survives(values: np.ndarray, tmp_path: Path):
    path = tmp_path / "run.mcap"
    path.unlink(missing_ok=True)
    rows = np.column_stack([np.arange(5.0), np.arange(5) * 1e5, values])
    rows[:, [PERIODS_MISSED, FLAGS, MODE, DRIVER_STATUS]] = 1.0  # A reader requires whole numbers.
    write_recording(path, rows)
    assert stock_rows(path).tobytes() == read_rows(path).tobytes() == rows.tobytes()


def test_messages_have_the_written_times_contents_and_checksums(path: Path, rows: np.ndarray):
    with path.open("rb") as file:
        messages = list(NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False))
    ticks, snapshots, headers, events = (
        [message for _, channel, message in messages if channel.topic == topic]
        for topic in ("/ticks", "/law", "/configuration", "/events")
    )
    assert [message.log_time for message in ticks] == [START_UNIX_NS + int(row[1]) for row in rows]
    assert all(message.publish_time == message.log_time for message in ticks)
    laws = [bytes(snapshot(k)) for k in range(0, COUNT, 1000)]
    assert [message.data for message in snapshots] == [hashlib.sha256(law).digest() + law for law in laws]
    (header,) = (json.loads(message.data) for message in headers)
    assert header["configuration_sha256"] == hashlib.sha256(header["configuration"].encode()).hexdigest()
    first, *_, last = (json.loads(message.data) for message in events)
    assert set(first) == {"tick", "time_ns", "kind", "who", "axis", "what"}
    assert last["kind"] == "finished"


def test_the_public_reader_finds_ticks_by_time(path: Path):
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary
        assert summary.statistics
        assert summary.statistics.channel_message_counts == {1: COUNT, 2: 4, 3: 3, 4: 1}
        begin = START_UNIX_NS + 2_500 * 100_000
        ticks = list(reader.iter_messages(topics=["/ticks"], starting_at=begin, ending_before=begin + 10 * 100_000))
    assert len(ticks) == 10


def test_chunks_are_small_and_without_padding(path: Path):
    assert chunk_rows(COLUMNS) * tick_dtype(COLUMNS).itemsize <= 1 << 20
    with path.open("rb") as file:
        chunks = [r for r in StreamReader(file, emit_chunks=True).records if type(r).__name__ == "Chunk"]
    assert all(chunk.uncompressed_crc and chunk.compression == "zstd" for chunk in chunks)


def test_the_schema_is_what_protobuf_itself_would_write():
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet

    names = column_names([f"axis{n}" for n in range(30)], ["a_um", "b_v"])
    expected = FileDescriptorSet()
    file = expected.file.add(name="rtloop/tick.proto", package="rtloop", syntax="proto2")
    message = file.message_type.add(name="Tick")
    kind, label = FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.LABEL_OPTIONAL
    for number, name in enumerate(names, start=1):
        message.field.add(name=name, number=number, label=label, type=kind)
    assert FileDescriptorSet.FromString(tick_schema(names)) == expected


def test_twelve_axes_are_read_back(tmp_path: Path):
    axes = [f"a{n}" for n in range(12)]
    names = column_names(axes, [])
    rows = np.random.default_rng(3).normal(size=(50, len(names)))
    rows[:, 0], rows[:, 1] = np.arange(50), np.arange(50) * 1e5
    path = write_recording(tmp_path / "run.mcap", rows, axes=axes, observed=[], columns=list(names))
    assert stock_rows(path, names).tobytes() == rows.tobytes()


def test_the_message_index_has_the_time_and_place_of_every_tick(tmp_path: Path):
    rows = make_rows(2_500)
    path = tmp_path / "run.mcap"
    writer = Writer(path, make_header(), START_UNIX_NS, message_index=True)
    for start in (0, 1_000, 2_000):
        writer.write_ticks(rows[start : start + 1_000])
    writer.finish(lambda logged: final_message(len(rows), logged))
    with path.open("rb") as file:
        records = list(StreamReader(file, emit_chunks=True).records)
    indexes = [r for r in records if isinstance(r, MessageIndex) and r.channel_id == TICKS]
    times = [time for index in indexes for time, _ in index.records]
    assert times == [START_UNIX_NS + int(row[1]) for row in rows]
    offsets = [offset for _, offset in indexes[0].records]
    assert offsets == [k * tick_dtype(COLUMNS).itemsize for k in range(1_000)]
    assert stock_rows(path).tobytes() == read_rows(path).tobytes() == rows.tobytes()


def test_the_file_is_finished_well_at_the_minimum_of_free_space(tmp_path: Path, rows: np.ndarray, monkeypatch):
    free = iter([10_000, 10_000, 10_000, 9_999])  # Free blocks of 1 KiB, call by call.
    status = SimpleNamespace(f_frsize=1024)
    monkeypatch.setattr("os.statvfs", lambda _: SimpleNamespace(**vars(status), f_bavail=next(free)))
    writer = Writer(tmp_path / "run.mcap", make_header(), 1, min_free_bytes=10_000 * 1024)
    writer.write_ticks(rows[:1000])
    writer.write_ticks(rows[1000:2000])
    with pytest.raises(OutputError, match="9 MiB are free; at least 9 MiB must stay free"):
        writer.write_ticks(rows[2000:])
    writer.finish(lambda logged: final_message(len(rows), logged))
    assert read_rows(tmp_path / "run.mcap").tobytes() == rows[:2000].tobytes()
    with Reader(tmp_path / "run.mcap") as reader:
        assert reader.totals
        assert (reader.totals["ticks_executed"], reader.totals["ticks_logged"]) == (len(rows), 2000)


def test_a_new_file_says_what_room_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.statvfs", lambda _: SimpleNamespace(f_frsize=1 << 20, f_bavail=520))
    need = "520 MiB are free; at least 500 MiB must stay free, and a new file needs 32 MiB"
    with pytest.raises(OutputError, match=need):
        Writer(tmp_path / "run.mcap", make_header(), 1, min_free_bytes=500 << 20, room_bytes=32 << 20)
    assert list(tmp_path.iterdir()) == []


def test_a_growing_file_needs_little_memory_for_each_chunk(tmp_path: Path):
    """A day without rotation has 350 000 chunks."""
    chunks = 400
    rows = make_rows(chunks)
    writer = Writer(tmp_path / "run.mcap", make_header(), START_UNIX_NS, message_index=True)
    writer.write_ticks(rows[:1])
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for number in range(1, chunks):
        writer.write_ticks(rows[number : number + 1])
    bytes_per_chunk = (tracemalloc.get_traced_memory()[0] - before) / (chunks - 1)
    tracemalloc.stop()
    writer.close()
    assert 50 < bytes_per_chunk < 400


def test_the_index_is_read_as_the_stock_reader_reads_it(path: Path):
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    with Reader(path) as reader:
        indexes = [entry.index for entry in reader.entries]
    assert len(indexes) > 2
    for index, stock in zip(indexes, summary.chunk_indexes, strict=True):
        assert index == (
            stock.chunk_start_offset, stock.chunk_length, stock.message_index_length, stock.message_start_time,
            stock.message_end_time, stock.uncompressed_size, tuple(stock.message_index_offsets),
        )  # fmt: skip

"""Numbers of topics that other programs wrote are read exactly: the oracle is the array given to the stock writers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import DESCRIPTOR as TIMESTAMP
from mcap.records import Schema
from mcap.writer import CompressionType, Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer

from rtloop.interchange.formats.from_mcap import read_mcap
from rtloop.interchange.formats.mcap_fields import DecodingError, _require_sizes
from rtloop.interchange.formats.table import UnreadableData

START_NS, STEP_NS, ROWS = 1_700_000_000_000_000_123, 99_999, 400
TRUTH = np.random.default_rng(5).standard_normal((ROWS, 3))
SECONDS = np.arange(ROWS) * STEP_NS * 1e-9


@contextmanager
def stock_writer(path: Path, **options: Any) -> Iterator[Writer]:
    """Yield a started writer of the mcap library, and finish its file afterwards."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        yield writer
        writer.finish()


def write_messages(path: Path, messages: list[Any], encoding: str = "json", schema: Any = None, **options: Any) -> Path:
    """Write messages (bytes, or values for JSON) to the topic `/imu`. Returns the path."""
    with stock_writer(path, **options) as writer:
        channel = writer.register_channel("/imu", encoding, writer.register_schema(*schema) if schema else 0)
        for place, message in enumerate(messages):
            data = message if isinstance(message, bytes) else json.dumps(message).encode()
            writer.add_message(channel, START_NS + place * STEP_NS, data, 0)
    return path


def samples() -> list[dict[str, Any]]:
    """Return ROWS messages with the numbers of TRUTH, a text, a bool and a count."""
    return [
        {"name": "a", "on": bool(place % 2), "accel": {"x": row[0], "yz": [row[1], row[2]]}, "counts": place}
        for place, row in enumerate(TRUTH.tolist())
    ]


def require_truth(path: Path, topic: str | None = None) -> None:
    """Require that a file is read as the table of TRUTH, with its times, counts and bools."""
    table = read_mcap(path, topic)
    assert table.time == "log_time_s"
    assert table.units["log_time_s"] == "s"
    np.testing.assert_allclose(table.columns["log_time_s"], SECONDS, rtol=0, atol=1e-15)
    for name, column in (("accel.x", 0), ("accel.yz.0", 1), ("accel.yz.1", 2)):
        assert table.columns[name].tobytes() == TRUTH[:, column].tobytes()
    assert table.columns["counts"].tolist() == list(range(ROWS))
    assert table.columns["on"].tolist() == [place % 2 for place in range(ROWS)]


@pytest.mark.parametrize("schema", [None, ("Imu", "jsonschema", b'{"type": "object"}')])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_json(tmp_path: Path, schema: Any, compression: CompressionType):
    path = write_messages(tmp_path / "a.mcap", samples(), schema=schema, compression=compression, chunk_size=9_000)
    require_truth(path)
    require_truth(path, "/imu")


def test_a_bare_number_that_is_missing_is_nan_in_the_same_column(tmp_path: Path):
    table = read_mcap(write_messages(tmp_path / "a.mcap", [1.5, None, "NaN", 2.5]))
    assert np.array_equal(table.columns["value"], [1.5, np.nan, np.nan, 2.5], equal_nan=True)


def imu_class() -> Any:
    """Return a class of protobuf messages with a nested, a repeated and a Timestamp field."""
    file = FileDescriptorProto(name="imu.proto", package="lab", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    xyz = file.message_type.add(name="Accel")
    xyz.field.add(name="x", number=1, type=Field.TYPE_DOUBLE, label=Field.LABEL_OPTIONAL)
    xyz.field.add(name="yz", number=2, type=Field.TYPE_DOUBLE, label=Field.LABEL_REPEATED)
    message = file.message_type.add(name="Imu")
    for number, (name, kind) in enumerate({"on": Field.TYPE_BOOL, "counts": Field.TYPE_UINT32}.items(), 1):
        message.field.add(name=name, number=number, type=kind, label=Field.LABEL_OPTIONAL)
    for number, (name, kind) in enumerate({"accel": ".lab.Accel", "at": ".google.protobuf.Timestamp"}.items(), 7):
        message.field.add(name=name, number=number, type=Field.TYPE_MESSAGE, type_name=kind, label=Field.LABEL_OPTIONAL)
    pool = DescriptorPool()
    pool.AddSerializedFile(TIMESTAMP.serialized_pb)
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("lab.Imu"))


def test_protobuf(tmp_path: Path):
    path, kind = tmp_path / "a.mcap", imu_class()
    with path.open("wb") as file, ProtobufWriter(file) as writer:
        for place, row in enumerate(TRUTH.tolist()):
            message = kind(on=bool(place % 2), counts=place, accel={"x": row[0], "yz": row[1:]})
            message.at.seconds, message.at.nanos = 1_700_000_000 + place, place
            writer.write_message("/imu", message, START_NS + place * STEP_NS, 0)
    require_truth(path)
    table = read_mcap(path)
    assert table.columns["at.seconds"].tolist() == [1_700_000_000.0 + place for place in range(ROWS)]
    assert table.columns["at.nanos"].tolist() == list(range(ROWS))


ROS2 = """bool on
uint32 counts
string name
lab_msgs/Accel accel
================================================================================
MSG: lab_msgs/Accel
float64 x
float64[] yz
"""


def test_ros2(tmp_path: Path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Ros2Writer(file)
        schema = writer.register_msgdef("lab_msgs/msg/Imu", ROS2)
        for place, row in enumerate(TRUTH.tolist()):
            message = {"on": bool(place % 2), "counts": place, "name": "a", "accel": {"x": row[0], "yz": row[1:]}}
            writer.write_message("/imu", schema, message, START_NS + place * STEP_NS, 0)
        writer.finish()
    require_truth(path)


def test_messages_in_another_order_and_fields_that_come_and_go(tmp_path: Path):
    path = tmp_path / "a.mcap"
    with stock_writer(path, chunk_size=50) as writer:
        channels = [writer.register_channel("/a", "json", 0, {"of": name}) for name in "xy"]
        for place in (3, 0, 2, 1):
            data = {"k": place} | ({"odd": None if place == 1 else "Infinity"} if place % 2 else {})
            writer.add_message(channels[place // 2], place * 1_000_000_000, json.dumps(data).encode(), 0)
    table = read_mcap(path)
    assert table.columns["log_time_s"].tolist() == table.columns["k"].tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(table.columns["odd"], [np.nan, np.nan, np.nan, np.inf])


def test_several_topics_are_named(tmp_path: Path):
    path = tmp_path / "a.mcap"
    with stock_writer(path) as writer:
        for name in ("/a", "/b"):
            writer.add_message(writer.register_channel(name, "json", 0), 0, b'{"x": 1}', 0)
    assert read_mcap(path, "/b").columns["x"].tolist() == [1]
    with pytest.raises(
        UnreadableData, match=r"select one with --group TOPIC: '/a' \(json, 1 messages\), '/b' \(json, 1 messages\)"
    ):
        read_mcap(path)
    with pytest.raises(UnreadableData, match=r"no topic '/c'; there are '/a'"):
        read_mcap(path, "/c")


def descriptors(*files: FileDescriptorProto) -> bytes:
    """Return the bytes of a FileDescriptorSet, which is the data of a protobuf schema."""
    return FileDescriptorSet(file=files).SerializeToString()


B = descriptors(FileDescriptorProto(name="b", package="lab", message_type=[DescriptorProto(name="B")]))
CIRCLE = descriptors(FileDescriptorProto(name="a", dependency=["b"]), FileDescriptorProto(name="b", dependency=["a"]))
RECURSIVE = ("a/msg/A", "ros2msg", b"a/A inner\n" + b"=" * 80 + b"\nMSG: a/A\na/A inner\n")
EMPTY_ITEMS = ("a/msg/A", "ros2msg", b"a/E[] all\n" + b"=" * 80 + b"\nMSG: a/E\n# nothing\n")
UNREADABLE: list[tuple[Any, str, Any, str]] = [
    (b"\x93NUMPY", "cbor", None, r"messages are encoded as cbor; allowed: json, protobuf and cdr \(ros2msg\)"),
    (b"", "ros1", ("a/A", "ros1msg", b"float64 x"), r"messages are encoded as ros1 \(ros1msg\)"),
    (b"", "protobuf", None, "messages are encoded as protobuf;"),
    (b"", "protobuf", ("A", "protobuf", b"\xff\xff"), "the schema 'A' cannot be read"),
    (b"", "protobuf", ("A", "protobuf", CIRCLE), "the schema 'A' cannot be read"),
    (b"\xff\xff", "protobuf", ("lab.B", "protobuf", B), "message 0: the contents do not match the schema"),
    (b"\0\1\0\0", "cdr", RECURSIVE, "message 0: the contents do not match the schema"),
    (b"\0\1\0\0\xff\xff\xff\xff", "cdr", EMPTY_ITEMS, "contains lists, and also a message type without fields"),
    (b"\0\1\0\0\xff\xff\xff\xff", "cdr", ("a/msg/A", "ros2msg", b"float64[] x"), "contents do not match the schema"),
    (b"", "cdr", ("a/msg/A", "ros2msg", b"\xff nonsense ["), "cannot be read|do not match the schema"),
    (b"{", "json", None, "message 0: not JSON"),
    (b"[" * 100_000, "json", None, "message 0: not JSON"),
    (b'{"a": "text"}', "json", None, "the messages contain no number"),
    (b'{"a": 1' + b"0" * 400 + b"}", "json", None, "too large"),
    (b'{"a":' * 60 + b"1" + b"}" * 60, "json", None, "nested too deeply; allowed: up to 50 levels"),
]  # fmt: skip


@pytest.mark.parametrize(("data", "encoding", "schema", "why"), UNREADABLE)
def test_unreadable_messages_are_refused_with_a_reason(
    tmp_path: Path, data: bytes, encoding: str, schema: Any, why: str
):
    path = write_messages(tmp_path / "a.mcap", [data], encoding, schema)
    with pytest.raises(UnreadableData, match=rf"a\.mcap: '/imu': .*({why})"):
        read_mcap(path)


def test_long_lists_are_left_out(tmp_path: Path):
    table = read_mcap(write_messages(tmp_path / "a.mcap", [{"picture": [0] * 5_000, "x": 1.5}]))
    assert set(table.columns) == {"log_time_s", "x"}


def test_messages_without_common_fields_are_no_table(tmp_path: Path):
    path = write_messages(tmp_path / "a.mcap", [{f"f{place % 3000}": 1} for place in range(9_000)])
    with pytest.raises(UnreadableData, match="not a table: 9000 messages have more than"):
        read_mcap(path)


@pytest.mark.parametrize("make", [lambda path: path.write_bytes(b"PK\x03\x04"), lambda path: None, Path.mkdir])
def test_no_mcap_file(tmp_path: Path, make: Callable[[Path], Any]):
    make(tmp_path / "a.mcap")
    with pytest.raises(UnreadableData, match=r"a\.mcap: "):
        read_mcap(tmp_path / "a.mcap")


def test_a_truncated_file_gives_its_complete_part(tmp_path: Path):
    path = write_messages(tmp_path / "a.mcap", samples(), chunk_size=4_000, compression=CompressionType.NONE)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    table = read_mcap(path)
    rows = len(table.columns["counts"])
    assert 20 < rows < ROWS
    assert table.columns["accel.x"].tobytes() == TRUTH[:rows, 0].tobytes()
    assert "the messages after the damage are left out" in table.about["problems"]


def test_bounded_fields_of_ros_2_are_fields():
    """A constant has "=", a bound "<=": a message of bounded fields is not empty."""
    bounded = Schema(data=b"float64[<=3] data\nstring<=10 name\n", encoding="ros2msg", id=1, name="lab/Bounded")
    _require_sizes(bounded)
    empty = b"lab/Empty[] parts\n" + b"=" * 80 + b"\nMSG: lab/Empty\nint32 SIZE=3\nstring TEXT=<=\n"
    with pytest.raises(DecodingError, match="without fields"):
        _require_sizes(Schema(data=empty, encoding="ros2msg", id=1, name="lab/List"))

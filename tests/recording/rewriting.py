"""Recordings written anew by the stock `mcap` library, as other tools do it; nothing of rtloop is used for it."""

from __future__ import annotations

import heapq
import json
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

ENCODINGS = ("as it is", "json", "proto3")


class Said(NamedTuple):
    """A message of a file, and of which of several files it is."""

    log_time: int
    topic: str
    data: bytes
    encoding: str
    schema: tuple[str, str, bytes] | None
    file: int = 0


def messages(path: Path, file: int = 0, *, in_order_of_time: bool = False) -> list[Said]:
    """All of a file, in its order or in that of the log times."""
    with path.open("rb") as stream:
        return [
            Said(one.log_time, channel.topic, one.data, channel.message_encoding,
                 schema and (schema.name, schema.encoding, schema.data), file)
            for schema, channel, one in make_reader(stream).iter_messages(log_time_order=in_order_of_time)
        ]  # fmt: skip


def merged(paths: Sequence[Path]) -> list[Said]:
    """What `mcap merge` makes of several files: all messages by their log times, with channels of each file's own."""
    parts = (messages(path, file, in_order_of_time=True) for file, path in enumerate(paths))
    return list(heapq.merge(*parts, key=lambda one: one.log_time))


def write(
    path: Path,
    said: Iterable[Said],
    *,
    ticks: str = "as it is",
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 1 << 20,
    spare: int = 0,
    beside: bool = False,
    flush_every: int = 0,
    header: tuple[str, str] | None = None,
    **options: Any,
) -> Path:
    """A file of some messages. `ticks`: how they are encoded, one of ENCODINGS; `spare`: so many numbers of
    channels and schemas are left out; `beside`: metadata, an attachment and a topic of somebody else's stand there too.
    """
    encode = Encoding(ticks)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_size, compression=compression, **options)
        writer.start(*(header or ()))
        for number in range(spare):
            schema = writer.register_schema(f"spare{number}", "jsonschema", b"{}")
            writer.register_channel(f"/spare{number}", "json", schema)
        known: dict[tuple[int, str], int] = {}
        for place, one in enumerate(said):
            encoding, schema, data = encode(one)
            key = (one.file, one.topic)
            if key not in known:
                number = writer.register_schema(*schema) if schema else 0
                known[key] = writer.register_channel(one.topic, encoding, number, {"file": str(one.file)})
            writer.add_message(known[key], one.log_time, data, one.log_time + 1, sequence=place)
            if beside and place % 50 == 0:
                if place == 0:
                    known[0, "/spare"] = writer.register_channel("/spare", "json", 0)
                    writer.add_metadata("about", {"written": "anew"})
                writer.add_message(known[0, "/spare"], one.log_time, b'{"temperature": 21.5}', 0)
                writer.add_attachment(0, one.log_time, "note.txt", "text/plain", b"\x05" * 200)
            if flush_every and place % flush_every == 0:
                writer.flush()
        writer.finish()
    return path


class Encoding:
    """Encodes the ticks otherwise, by the schema that they came with; every other message stays."""

    def __init__(self, ticks: str) -> None:
        assert ticks in ENCODINGS
        self._ticks = ticks
        self._decode: Callable[[bytes], Any] | None = None
        self._kind: Any = None

    def __call__(self, one: Said) -> tuple[str, tuple[str, str, bytes] | None, bytes]:
        """Encoding, schema and bytes."""
        if one.topic != "/ticks" or self._ticks == "as it is":
            return one.encoding, one.schema, one.data
        assert one.schema
        if self._decode is None:
            self._decode = DecoderFactory().decoder_for("protobuf", _schema(*one.schema))
        assert self._decode
        message = self._decode(one.data)
        if self._ticks == "json":
            return "json", None, json.dumps({field.name: value for field, value in message.ListFields()}).encode()
        if self._kind is None:
            self._kind = backwards([field.name for field in message.DESCRIPTOR.fields])
        again = self._kind(**{field.name: value for field, value in message.ListFields()})
        described = build_file_descriptor_set(self._kind).SerializeToString()
        return "protobuf", (self._kind.DESCRIPTOR.full_name, "protobuf", described), again.SerializeToString()


def _schema(name: str, encoding: str, data: bytes) -> Schema:
    return Schema(id=1, name=name, encoding=encoding, data=data)


def backwards(names: Sequence[str]) -> Any:
    """A message of the same fields with their numbers the other way round; proto3 leaves zeros out."""
    file = FileDescriptorProto(name="another/tick.proto", package="another", syntax="proto3")
    message = file.message_type.add(name="Sample")
    for place, name in enumerate(names):
        kind, label = FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.LABEL_OPTIONAL
        message.field.add(name=name, number=len(names) - place, type=kind, label=label)
    pool = DescriptorPool()
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("another.Sample"))


def without_end(path: Path) -> Path:
    """Cut off in front of the data end, as by a tool that was killed."""
    data = path.read_bytes()
    (summary,) = struct.unpack_from("<Q", data, len(data) - 8 - 20)
    path.write_bytes(data[: summary - 13])
    return path


NO_INDEX = IndexType.NONE

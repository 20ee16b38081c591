"""Rewrite recordings by the stock `mcap` library, as other tools do; no code of rtloop is used."""

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

ENCODINGS = ("unchanged", "json", "proto3")


class FileMessage(NamedTuple):
    """A message of the file number `file`, with its schema (name, encoding, data)."""

    log_time: int
    topic: str
    data: bytes
    encoding: str
    schema: tuple[str, str, bytes] | None
    file: int = 0


def messages(path: Path, file: int = 0, *, in_order_of_time: bool = False) -> list[FileMessage]:
    """Return all messages of a file, in the order of the file or of the log times."""
    with path.open("rb") as stream:
        return [
            FileMessage(message.log_time, channel.topic, message.data, channel.message_encoding,
                        schema and (schema.name, schema.encoding, schema.data), file)
            for schema, channel, message in make_reader(stream).iter_messages(log_time_order=in_order_of_time)
        ]  # fmt: skip


def merge(paths: Sequence[Path]) -> list[FileMessage]:
    """Return the messages of all files by log time, with separate channels for each file, as `mcap merge` does."""
    parts = (messages(path, file, in_order_of_time=True) for file, path in enumerate(paths))
    return list(heapq.merge(*parts, key=lambda message: message.log_time))


def write(
    path: Path,
    messages: Iterable[FileMessage],
    *,
    ticks: str = "unchanged",
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 1 << 20,
    spare: int = 0,
    foreign: bool = False,
    header: tuple[str, str] | None = None,
    **options: Any,
) -> Path:
    """Write a file of messages. Returns its path.

    `ticks`, one of ENCODINGS, is the encoding of the ticks; the first `spare` numbers of channels and schemas are
    skipped; `foreign` adds metadata, an attachment and a topic of another program.
    """
    encode = TickEncoder(ticks)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_size, compression=compression, **options)
        writer.start(*(header or ()))
        for number in range(spare):
            schema = writer.register_schema(f"spare{number}", "jsonschema", b"{}")
            writer.register_channel(f"/spare{number}", "json", schema)
        channels: dict[tuple[int, str], int] = {}
        for place, message in enumerate(messages):
            encoding, schema, data = encode(message)
            key = (message.file, message.topic)
            if key not in channels:
                number = writer.register_schema(*schema) if schema else 0
                channels[key] = writer.register_channel(message.topic, encoding, number, {"file": str(message.file)})
            writer.add_message(channels[key], message.log_time, data, message.log_time + 1, sequence=place)
            if foreign and place % 50 == 0:
                if place == 0:
                    channels[0, "/spare"] = writer.register_channel("/spare", "json", 0)
                    writer.add_metadata("about", {"written": "anew"})
                writer.add_message(channels[0, "/spare"], message.log_time, b'{"temperature": 21.5}', 0)
                writer.add_attachment(0, message.log_time, "note.txt", "text/plain", b"\x05" * 200)
        writer.finish()
    return path


class TickEncoder:
    """Encoder of ticks, which are decoded by their schema; other messages stay unchanged."""

    def __init__(self, ticks: str) -> None:
        assert ticks in ENCODINGS
        self._ticks = ticks
        self._decode: Callable[[bytes], Any] | None = None
        self._type: Any = None

    def __call__(self, original: FileMessage) -> tuple[str, tuple[str, str, bytes] | None, bytes]:
        """Return encoding, schema and bytes of a message."""
        if original.topic != "/ticks" or self._ticks == "unchanged":
            return original.encoding, original.schema, original.data
        assert original.schema
        if self._decode is None:
            name, encoding, data = original.schema
            self._decode = DecoderFactory().decoder_for("protobuf", Schema(1, data, encoding, name))
        assert self._decode
        message = self._decode(original.data)
        if self._ticks == "json":
            return "json", None, json.dumps({field.name: value for field, value in message.ListFields()}).encode()
        if self._type is None:
            self._type = reversed_fields([field.name for field in message.DESCRIPTOR.fields])
        encoded = self._type(**{field.name: value for field, value in message.ListFields()})
        descriptors = build_file_descriptor_set(self._type).SerializeToString()
        return "protobuf", (self._type.DESCRIPTOR.full_name, "protobuf", descriptors), encoded.SerializeToString()


def reversed_fields(names: Sequence[str]) -> Any:
    """Return a message class (proto3, which omits zeros) of the same fields with their numbers reversed."""
    file = FileDescriptorProto(name="another/tick.proto", package="another", syntax="proto3")
    message = file.message_type.add(name="Sample")
    for place, name in enumerate(names):
        kind, label = FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.LABEL_OPTIONAL
        message.field.add(name=name, number=len(names) - place, type=kind, label=label)
    pool = DescriptorPool()
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("another.Sample"))


def cut_off_end(path: Path) -> Path:
    """Cut a file off before its data end, as a killed tool leaves the file. Returns its path."""
    data = path.read_bytes()
    (summary,) = struct.unpack_from("<Q", data, len(data) - 8 - 20)
    path.write_bytes(data[: summary - 13])
    return path


NO_INDEX = IndexType.NONE

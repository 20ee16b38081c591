"""The numbers in a message, by name: nested ones with dots between, items of lists by their places.

JSON by itself; protobuf by the descriptors that the file holds; ROS 2's CDR by the file's message definitions. Those
of ROS 1 are not decoded: the libraries that there are make code of the definitions that a file holds, and run it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pydantic_core
from mcap.records import Channel, Schema

from rtloop.errors import MissingExtra
from rtloop.recording.file.mcap.stock import encoding

MOST_FIELDS = 2000
MOST_ITEMS = 1000
"""Of a list: longer ones are pictures and the like, and are left out."""
DEEPEST = 50
SHOWN = 60
"""Characters of a name in a message."""
ENCODINGS = "json, protobuf and cdr (ros2msg)"
Fields = dict[str, float]
WORDS = {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf", "nan": "nan", "inf": "inf", "-inf": "-inf"}
"""Numbers that JSON has no words for, as the usual writers spell them."""


class Undecodable(ValueError):
    """What is wrong with a message or with what describes it."""


def decoder(channel: Channel, schema: Schema | None) -> Callable[[bytes], Fields]:
    """What makes numbers of a channel's messages; it raises Undecodable.

    Raises Undecodable where the encoding is not among those that can be read, MissingExtra.
    """
    described = schema.encoding if schema else ""
    if channel.message_encoding == "json":
        return _json
    if (channel.message_encoding, described) == ("protobuf", "protobuf") and schema:
        return _protobuf(schema)
    if (channel.message_encoding, described) == ("cdr", "ros2msg") and schema:
        return _ros2(schema)
    raise Undecodable(f"its messages are {encoding(channel, schema)}; {ENCODINGS} can be read")


def _flat(value: Any, children: Callable[[Any], Iterator[tuple[str, Any]] | None]) -> Fields:
    """All numbers in `value`. Raises Undecodable."""
    found: Fields = {}
    waiting: list[tuple[str, Any, int]] = [("", value, 0)]
    while waiting:
        name, one, depth = waiting.pop()
        inner = children(one)
        if inner is not None:
            if depth >= DEEPEST:
                raise Undecodable(f"its fields are nested more than {DEEPEST} deep")
            below = [(f"{name}.{key}" if name else key, child, depth + 1) for key, child in inner]
            waiting += reversed(below)
        elif isinstance(one, bool | int | float):
            found[name or "value"] = _double(one)
        elif one is None or (isinstance(one, str) and one in WORDS):
            found[name] = float(WORDS[one] if one else "nan")
        if len(found) + len(waiting) > MOST_FIELDS:
            raise Undecodable(f"it has more than {MOST_FIELDS} fields")
    return found


def _double(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        raise Undecodable("a whole number in it is too large") from None


def _items(values: Any) -> Iterator[tuple[str, Any]]:
    return ((str(place), value) for place, value in enumerate(values)) if len(values) <= MOST_ITEMS else iter(())


def _json(payload: bytes) -> Fields:
    try:
        found = pydantic_core.from_json(payload, allow_inf_nan=True)
    except ValueError:
        raise Undecodable("it is not JSON") from None
    if isinstance(found, dict) and len(found) <= MOST_FIELDS and {*map(type, found.values())} == {float}:
        return found  # the usual case, and many times as fast
    return _flat(found, _json_children)


def _json_children(value: Any) -> Iterator[tuple[str, Any]] | None:
    if isinstance(value, dict):
        return iter(value.items())
    return _items(value) if isinstance(value, list) else None


def message_class(schema: Schema) -> Any:
    """The class of a protobuf schema's messages. Raises Undecodable, MissingExtra."""
    try:
        from google.protobuf.descriptor_pb2 import FileDescriptorSet
        from google.protobuf.descriptor_pool import DescriptorPool
        from google.protobuf.message_factory import GetMessageClass
    except ImportError:
        raise MissingExtra("messages in protobuf need its library: pip install 'rtloop[data]'") from None
    pool = DescriptorPool()
    try:
        waiting = {file.name: file for file in FileDescriptorSet.FromString(schema.data).file}
        while waiting:  # each behind those that it needs
            ready = [name for name, file in waiting.items() if waiting.keys().isdisjoint(file.dependency)]
            for name in ready or waiting:
                pool.Add(waiting[name])
            waiting = {name: file for name, file in waiting.items() if name not in ready} if ready else {}
        return GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except Exception as error:  # whatever the library makes of foreign bytes
        raise Undecodable(f"its schema {schema.name[:SHOWN]!r} cannot be read ({type(error).__name__})") from None


def _protobuf(schema: Schema) -> Callable[[bytes], Fields]:
    kind = message_class(schema)
    from google.protobuf.message import DecodeError, Message

    def children(value: Any) -> Iterator[tuple[str, Any]] | None:
        if isinstance(value, Message):
            return _present(value)
        if isinstance(value, Mapping):
            return ((str(key), one) for key, one in value.items())
        return _items(value) if hasattr(value, "MergeFrom") else None

    def decode(payload: bytes) -> Fields:
        try:
            return _flat(kind.FromString(payload), children)
        except (DecodeError, RecursionError):
            raise Undecodable("it is not what its schema says") from None

    return decode


def _present(message: Any) -> Iterator[tuple[str, Any]]:
    """The fields that a protobuf message has: all but those that it could leave out, and did."""
    for field in message.DESCRIPTOR.fields:
        if not field.has_presence or message.HasField(field.name):
            yield field.name, getattr(message, field.name)


def _ros2(schema: Schema) -> Callable[[bytes], Fields]:
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise MissingExtra("messages of ROS 2 need mcap-ros2-support: pip install 'rtloop[data]'") from None
    _require_sizes(schema)
    try:
        read = DecoderFactory().decoder_for("cdr", schema)
    except Exception as error:  # a parser of foreign text, of which nothing is promised
        raise Undecodable(f"its schema {schema.name[:SHOWN]!r} cannot be read ({type(error).__name__})") from None

    def decode(payload: bytes) -> Fields:
        try:
            return _flat(read(payload), _ros2_children)  # type: ignore[misc]
        except Undecodable:
            raise
        except Exception:
            raise Undecodable("it is not what its schema says") from None

    return decode


def _ros2_children(value: Any) -> Iterator[tuple[str, Any]] | None:
    if hasattr(value, "__slots__") and not isinstance(value, bytes | memoryview):
        return ((name, getattr(value, name)) for name in value.__slots__)
    return _items(value) if isinstance(value, list | tuple) else None


def _require_sizes(schema: Schema) -> None:
    """Raise Undecodable where a message definition would make much of few bytes: an array of what takes none."""
    text = schema.data.decode(errors="replace")
    for definition in re.split(r"^=+\s*$", text, flags=re.MULTILINE):
        lines = [line.partition("#")[0].strip() for line in definition.splitlines()]
        if not any(line and not line.startswith("MSG:") and "=" not in line for line in lines) and "[" in text:
            raise Undecodable(f"its schema {schema.name[:SHOWN]!r} has a message without fields, and lists")

"""Numbers of an MCAP message by name: dots between nested names, items of lists by their numbers.

JSON needs no description; protobuf is decoded by the file's descriptors, ROS 2's CDR by the file's message definitions.
ROS 1 is not decoded: the available libraries generate code from a file's definitions, and run it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import pydantic_core
from mcap.records import Channel, Schema

from rtloop.errors import MissingExtra
from rtloop.recording.file.mcap.stock import encoding

if TYPE_CHECKING:
    from google.protobuf.message import Message

MOST_FIELDS = 2000
MOST_ITEMS = 1000
"""Length limit for a list: longer ones are images and the like, and are left out."""
DEEPEST = 50
SHOWN = 60
"""Length limit for a name in a message."""
ENCODINGS = "json, protobuf and cdr (ros2msg)"
Fields = dict[str, float]
WORDS = {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf", "nan": "nan", "inf": "inf", "-inf": "-inf"}
"""Numbers for which JSON has no words, as the usual writers spell them."""


class DecodingError(ValueError):
    """A message, or its description, cannot be decoded; the text says why."""


def decoder(channel: Channel, schema: Schema | None) -> Callable[[bytes], Fields]:
    """Return a function that decodes a channel's messages into numbers by name; it raises DecodingError.

    Raises DecodingError for an unknown encoding or an unreadable schema, MissingExtra if the decoder's package is
    missing.
    """
    schema_encoding = schema.encoding if schema else ""
    if channel.message_encoding == "json":
        return _json
    if (channel.message_encoding, schema_encoding) == ("protobuf", "protobuf") and schema:
        return _protobuf(schema)
    if (channel.message_encoding, schema_encoding) == ("cdr", "ros2msg") and schema:
        return _ros2(schema)
    raise DecodingError(f"messages are encoded as {encoding(channel, schema)}; allowed: {ENCODINGS}")


def _flat(value: object, children: Callable[[object], Iterator[tuple[str, object]] | None]) -> Fields:
    """Return all numbers in `value` by name; `children` gives the named parts of a value, None for a leaf.

    True and False are 1 and 0, None is NaN. A text counts only if it is one of WORDS, such as "NaN" and "-Infinity";
    any other text, "1.5" too, is left out. A bare number is called `value`. Raises DecodingError for too many or too
    deeply nested fields, and for too large an integer.
    """
    fields: Fields = {}
    pending: list[tuple[str, object, int]] = [("", value, 0)]
    while pending:
        name, node, depth = pending.pop()
        parts = children(node)
        if parts is not None:
            if depth >= DEEPEST:
                raise DecodingError(f"fields are nested too deeply; allowed: up to {DEEPEST} levels")
            named_parts = [(f"{name}.{key}" if name else key, child, depth + 1) for key, child in parts]
            pending += reversed(named_parts)
        elif isinstance(node, bool | int | float):
            fields[name or "value"] = _double(node)
        elif node is None or (isinstance(node, str) and node in WORDS):
            fields[name or "value"] = float(WORDS[node] if node else "nan")
        if len(fields) + len(pending) > MOST_FIELDS:
            raise DecodingError(f"too many fields; allowed: up to {MOST_FIELDS}")
    return fields


def _double(value: float) -> float:
    """Return a number as float. Raises DecodingError for an integer that is too large."""
    try:
        return float(value)
    except OverflowError:
        raise DecodingError("an integer is too large for a 64-bit float") from None


def _items(values: Collection[object]) -> Iterator[tuple[str, object]]:
    """Return the items of a list with their numbers, from 0, as names; none for a list beyond MOST_ITEMS."""
    return ((str(place), value) for place, value in enumerate(values)) if len(values) <= MOST_ITEMS else iter(())


def _json(payload: bytes) -> Fields:
    """Return the numbers of a message in JSON by name. Raises DecodingError if it is not JSON or `_flat` refuses it."""
    try:
        content = pydantic_core.from_json(payload, allow_inf_nan=True)
    except ValueError:
        raise DecodingError("not JSON") from None
    if isinstance(content, dict) and len(content) <= MOST_FIELDS and {*map(type, content.values())} == {float}:
        return content  # the usual case, and many times as fast
    return _flat(content, _json_children)


def _json_children(value: object) -> Iterator[tuple[str, object]] | None:
    """Return the named parts of a JSON value; None for a leaf."""
    if isinstance(value, dict):
        return iter(value.items())
    return _items(value) if isinstance(value, list) else None


def message_class(schema: Schema) -> type[Message]:
    """Return the class of a protobuf schema's messages.

    Raises DecodingError if the schema cannot be read, MissingExtra without protobuf.
    """
    try:
        from google.protobuf.descriptor_pb2 import FileDescriptorSet
        from google.protobuf.descriptor_pool import DescriptorPool
        from google.protobuf.message_factory import GetMessageClass
    except ImportError:
        raise MissingExtra("messages in protobuf need the package protobuf: pip install 'rtloop[data]'") from None
    pool = DescriptorPool()
    try:
        pending = {file.name: file for file in FileDescriptorSet.FromString(schema.data).file}
        while pending:  # each file after the files that it imports
            ready = [name for name, file in pending.items() if pending.keys().isdisjoint(file.dependency)]
            for name in ready or pending:
                pool.Add(pending[name])
            pending = {name: file for name, file in pending.items() if name not in ready} if ready else {}
        return GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except Exception as error:  # the library documents no errors for foreign bytes
        raise DecodingError(f"the schema {schema.name[:SHOWN]!r} cannot be read ({type(error).__name__})") from None


def _protobuf(schema: Schema) -> Callable[[bytes], Fields]:
    """Return a decoder of a schema's messages in protobuf; it raises DecodingError.

    Raises DecodingError if the schema cannot be read, MissingExtra without protobuf.
    """
    kind = message_class(schema)
    from google.protobuf.message import DecodeError, Message

    def children(value: Any) -> Iterator[tuple[str, object]] | None:
        """Return the named parts of a protobuf value; None for a leaf."""
        if isinstance(value, Message):
            return _present(value)
        if isinstance(value, Mapping):
            return ((str(key), item) for key, item in value.items())
        return _items(value) if hasattr(value, "MergeFrom") else None

    def decode(payload: bytes) -> Fields:
        """Return the numbers of a message by name. Raises DecodingError if it does not fit its schema."""
        try:
            return _flat(kind.FromString(payload), children)
        except (DecodeError, RecursionError):
            raise DecodingError("the contents do not match the schema of the message") from None

    return decode


def _present(message: Message) -> Iterator[tuple[str, object]]:
    """Yield name and value of each field of a protobuf message; a field with presence only if it is set."""
    for field in message.DESCRIPTOR.fields:
        if not field.has_presence or message.HasField(field.name):
            yield field.name, getattr(message, field.name)


def _ros2(schema: Schema) -> Callable[[bytes], Fields]:
    """Return a decoder of a schema's messages in CDR; it raises DecodingError.

    Raises DecodingError if the schema cannot be read, MissingExtra without mcap-ros2-support.
    """
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise MissingExtra("messages of ROS 2 need mcap-ros2-support: pip install 'rtloop[data]'") from None
    _require_sizes(schema)
    try:
        read = DecoderFactory().decoder_for("cdr", schema)
    except Exception as error:  # the parser documents no errors for foreign text
        raise DecodingError(f"the schema {schema.name[:SHOWN]!r} cannot be read ({type(error).__name__})") from None

    def decode(payload: bytes) -> Fields:
        """Return the numbers of a message by name. Raises DecodingError if it does not fit its schema."""
        try:
            return _flat(read(payload), _ros2_children)  # type: ignore[misc]
        except DecodingError:
            raise
        except Exception:
            raise DecodingError("the contents do not match the schema of the message") from None

    return decode


def _ros2_children(value: Any) -> Iterator[tuple[str, object]] | None:
    """Return the named parts of a ROS 2 value; None for a leaf."""
    if hasattr(value, "__slots__") and not isinstance(value, bytes | memoryview):
        return ((name, getattr(value, name)) for name in value.__slots__)
    return _items(value) if isinstance(value, list | tuple) else None


def _require_sizes(schema: Schema) -> None:
    """Raise DecodingError for a schema that has both lists and a message type without fields.

    A list of such messages could expand a few bytes to any length.
    """
    text = schema.data.decode(errors="replace")
    for definition in re.split(r"^=+\s*$", text, flags=re.MULTILINE):
        lines = [line.partition("#")[0].strip() for line in definition.splitlines()]
        # A constant has "="; "<=" is the bound of a field.
        if (
            not any(line and not line.startswith("MSG:") and "=" not in line.replace("<=", "") for line in lines)
            and "[" in text
        ):
            raise DecodingError(
                f"schema {schema.name[:SHOWN]!r}: contains lists, and also a message type without fields; such a "
                "schema cannot be read. Write the file without the empty message type"
            )

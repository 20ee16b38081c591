"""Format of a recording: topics, schemas and the exact layout of a tick's message.

A tick is one MCAP message record of fixed length, so a chunk of ticks is an array of `tick_dtype`: it is encoded and
decoded a whole chunk at a time. Its payload is protobuf (https://protobuf.dev/programming-guides/encoding): per
column one tag and eight bytes, with explicit presence, so that zeros are written too.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NotRequired, TypedDict

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from rtloop.foundation.arrays import Real
from rtloop.signals import DEADLINE

FORMAT = 2
"""Newest format that is read: 2 for recordings around events, 1 for all others."""
PROFILE = "rtloop"
LIBRARY = "rtloop"
TICKS, EVENTS, LAW, CONFIGURATION = 1, 2, 3, 4
"""Channel ids, which are the same in every recording."""
OVERVIEW, OVERVIEW_TOPIC = 5, "/overview"
"""Channel id and topic that only recordings around events have."""
TICK_SCHEMA, EVENT_SCHEMA, CONFIGURATION_SCHEMA, OVERVIEW_SCHEMA = 1, 2, 3, 4
LAW_ENCODING = "rtloop-law"
"""Message encoding of `/law`: SHA-256 of the rest (32 bytes), tick (uint64, little-endian), the bytes of the law."""
MAX_CHUNK_BYTES = 1 << 20
PREFIX_BYTES = 9
"""Size of the opcode and length before every MCAP record."""
SHORT_TAGS = 15
"""Largest field number with a tag of one byte; tags up to 2047 have two bytes."""

Records = np.ndarray[Any, Any]
_DOUBLE = 1
_WIRE_64BIT = 1
_WIRE_BYTES = 2
_EVENT = {
    "title": "rtloop.Event",
    "type": "object",
    "properties": {
        "tick": {"type": "integer"},
        "time_ns": {"type": "integer", "description": "since the start of the run"},
        "kind": {"type": "string"},
        "who": {"type": "string"},
        "axis": {"type": ["string", "null"]},
        "what": {"type": "object"},
    },
}
_CONFIGURATION = {"title": "rtloop.Configuration", "type": "object"}


class CutOrigin(TypedDict):
    """Header field `cut`: the range of ticks from `first` to before `end` of the original `files`."""

    first: int
    end: int
    files: list[str]


class AroundEvents(TypedDict):
    """Header field `around`: settings of a recording around events."""

    before_s: float
    after_s: float
    on: list[str]
    every_s: float


class ImportOrigin(TypedDict):
    """Header field `imported`: source file and import settings of signals from another program."""

    file: str
    sha256: str
    time: str
    mapping: dict[str, str]
    units: dict[str, str]
    notes: list[str]
    position_first: NotRequired[bool]


class Header(TypedDict):
    """Fields of a recording's header that are read. Imported signals have None as `law`, and no `driver`."""

    name: str
    created_unix_ns: int
    axes: list[str]
    observed: list[str]
    columns: list[str]
    rate_hz: float
    paced: bool
    ticks_expected: NotRequired[int | None]
    configuration: str
    folder: NotRequired[str]
    law: Any
    driver: dict[str, Any]
    realtime: dict[str, object]
    versions: dict[str, str | None]
    host: dict[str, Any]
    extras: NotRequired[dict[str, list[dict[str, Any]]]]
    sequence: NotRequired[int]
    first_tick: NotRequired[int]
    repeats_before: NotRequired[int]
    cut: NotRequired[CutOrigin | None]
    around: NotRequired[AroundEvents | None]
    imported: NotRequired[ImportOrigin]


class Totals(TypedDict):
    """Totals in the event that ends a file."""

    ticks_executed: int
    ticks_logged: int
    ticks_lost: int
    events_lost: int
    result: str
    complete: bool
    driver_error: NotRequired[str | None]


def _varint(value: int) -> bytes:
    """Encode a number as a protobuf varint."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _number(field: int, value: int) -> bytes:
    """Encode the protobuf field with number `field`, which holds the number `value`."""
    return _varint(field << 3) + _varint(value)


def _text(field: int, value: bytes | str) -> bytes:
    """Encode the protobuf field with number `field`, which holds text or another, encoded message."""
    data = value.encode() if isinstance(value, str) else value
    return _varint(field << 3 | _WIRE_BYTES) + _varint(len(data)) + data


def doubles_schema(name: str, columns: Sequence[str]) -> bytes:
    """Serialised FileDescriptorSet of `rtloop.NAME` (proto2): column i, from 0, is `optional double COLUMN = i + 1`."""
    fields = b"".join(
        _text(2, _text(1, column) + _number(3, number) + _number(4, 1) + _number(5, _DOUBLE))
        for number, column in enumerate(columns, start=1)
    )
    file = _text(1, f"rtloop/{name.lower()}.proto") + _text(2, "rtloop") + _text(4, _text(1, name) + fields)
    return _text(1, file + _text(12, "proto2"))


def tick_schema(columns: Sequence[str]) -> bytes:
    """Serialised schema of the topic `/ticks`."""
    return doubles_schema("Tick", columns)


def schemas(columns: Sequence[str]) -> list[Schema]:
    """Schema records of `/ticks` with `columns`, `/events` and `/configuration`, but not of `/overview`."""
    return [
        Schema(id=TICK_SCHEMA, name="rtloop.Tick", encoding="protobuf", data=tick_schema(columns)),
        Schema(id=EVENT_SCHEMA, name="rtloop.Event", encoding="jsonschema", data=json.dumps(_EVENT).encode()),
        Schema(
            id=CONFIGURATION_SCHEMA,
            name="rtloop.Configuration",
            encoding="jsonschema",
            data=json.dumps(_CONFIGURATION).encode(),
        ),
    ]


def channels() -> list[Channel]:
    """Channel records of every recording: `/ticks`, `/events`, `/law`, `/configuration`."""
    rows = (
        (TICKS, "/ticks", "protobuf", TICK_SCHEMA),
        (EVENTS, "/events", "json", EVENT_SCHEMA),
        (LAW, "/law", LAW_ENCODING, 0),
        (CONFIGURATION, "/configuration", "json", CONFIGURATION_SCHEMA),
    )
    return [
        Channel(id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=schema)
        for number, topic, encoding, schema in rows
    ]


def tick_dtype(columns: Sequence[str]) -> np.dtype[np.void]:
    """Type of a tick's whole MCAP message record, prefix included, without padding; columns by name."""
    fields = [("_opcode", "u1"), ("_length", "<u8"), ("_channel", "<u2"), ("_sequence", "<u4")]
    fields += [("_log_time", "<u8"), ("_publish_time", "<u8")]
    return np.dtype(fields + doubles(columns))


def doubles(columns: Sequence[str]) -> list[tuple[str, str]]:
    """Fields (name, type) of a numpy dtype for a protobuf message of doubles.

    Column number N, from 1 on, has two fields: its tag, named "_tag_" and N, and then its double with its own name.
    """
    fields: list[tuple[str, str]] = []
    for number, name in enumerate(columns, start=1):
        fields += [(f"_tag_{number}", f"V{len(_double_tag(number))}"), (name, "<f8")]
    return fields


def fill_tags(records: Records, columns: Sequence[str]) -> None:
    """Write the tag before each column into `records`, which have the fields of `doubles`."""
    for number in range(1, len(columns) + 1):
        records[f"_tag_{number}"] = np.void(_double_tag(number))


def _double_tag(number: int) -> bytes:
    """Return the protobuf tag of field number `number`, a double."""
    return _varint(number << 3 | _WIRE_64BIT)


def fixed_bytes(template: Records, varying: Sequence[str]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.uint8]]:
    """Positions and values of the bytes of `template` (1,) outside the fields `varying` of eight bytes."""
    is_fixed = np.ones(template.itemsize, bool)
    for name in varying:
        _, start, *_ = (template.dtype.fields or {})[name]  # pyright: ignore[reportArgumentType]
        is_fixed[start : start + 8] = False
    fixed = np.flatnonzero(is_fixed)
    return fixed, template.view(np.uint8)[fixed]


def blank_ticks(columns: Sequence[str], count: int) -> Records:
    """Make `count` records of `tick_dtype` with all bytes that are the same for every tick; the others are 0."""
    records = np.zeros(count, tick_dtype(columns))
    records["_opcode"] = Opcode.MESSAGE
    records["_length"] = records.dtype.itemsize - PREFIX_BYTES
    records["_channel"] = TICKS
    fill_tags(records, columns)
    return records


def fill_ticks(records: Records, columns: Sequence[str], rows: Real, start_unix_ns: int) -> None:
    """Write `rows` (n, columns) float64 into `records` (n,) of `blank_ticks`.

    Log time and publish time = `start_unix_ns` + deadline, in ns.
    """
    short = SHORT_TAGS
    for names, values, tag_bytes in ((columns[:short], rows[:, :short], 1), (columns[short:], rows[:, short:], 2)):
        if names:  # One strided copy for all columns whose tags are equally long.
            offset = records.dtype.fields[names[0]][1]  # type: ignore[index]
            strides = (records.dtype.itemsize, tag_bytes + values.itemsize)
            np.ndarray(values.shape, "<f8", records.view(np.uint8), offset, strides)[:] = values
    records["_log_time"] = rows[:, DEADLINE].astype(np.int64) + start_unix_ns
    records["_publish_time"] = records["_log_time"]


def chunk_rows(columns: Sequence[str]) -> int:
    """Number of ticks in a full chunk."""
    return MAX_CHUNK_BYTES // tick_dtype(columns).itemsize

"""The beginning of a recording: schemas, channels and the `/configuration` message, checked against each other."""

from __future__ import annotations

import hashlib
import io
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel

from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.container import DamagedChunk, pack_records, split_records
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import split_messages
from rtloop.recording.file.topics.validation import MalformedText, parse_header, require_columns

EVERY_TICK_CHANNELS = [(one.id, one.topic) for one in format.channels()]
OWN_CHANNELS = (EVERY_TICK_CHANNELS, [*EVERY_TICK_CHANNELS, (format.OVERVIEW, format.OVERVIEW_TOPIC)])
"""Of a recording of every tick, and of one around events."""
RUN_KEYS = ("created_unix_ns", "name", "columns")
"""What is the same in the headers of all files of a run."""


def own_header_payload(content: bytes) -> bytes:
    """The text of the header, in the first chunk of a file that rtloop wrote. Raises DamagedChunk for any other."""
    messages = split_messages(content)
    if [message.channel for message in messages] != [format.CONFIGURATION]:
        raise DamagedChunk("it has no header")
    try:
        channels = [
            Channel.read(ReadDataStream(io.BytesIO(record)))
            for opcode, record in split_records(content)
            if opcode == Opcode.CHANNEL
        ]
    except (struct.error, ValueError, McapError):
        raise DamagedChunk("its channels cannot be read") from None
    if [(channel.id, channel.topic) for channel in channels] not in OWN_CHANNELS:
        raise DamagedChunk("its channels are not those of a recording")
    return messages[0].payload


def read_header(path: Path, payload: bytes, content: bytes | None = None) -> dict[str, Any]:
    """The header of the recording; `content`: the first chunk, whose schemas it is held against.

    Raises RecordingError where it is one of a newer version, or malformed.
    """
    try:
        header = parse_header(payload)
        digest = hashlib.sha256(header["configuration"].encode()).hexdigest()
        if header.get("configuration_sha256") != digest:
            raise MalformedText("the recorded configuration does not match its SHA-256")
        expected_records = pack_records([*format.schemas(header["columns"]), *format.channels()])
        if content is not None and not content.startswith(expected_records):
            raise MalformedText("the schema of the ticks does not match the recorded columns")
        require_columns(header)
    except MalformedText as reason:
        raise RecordingError(f"{path}: header of the recording: {reason}") from None
    return header


def missing_part_messages(numbers: Iterable[int]) -> list[str]:
    """What is missing between, or in front of, the parts of a rotated run that are there; one alone is a whole one."""
    present = set(numbers)
    if len(present) == 1:
        return []
    return [missing_part_message(number) for number in range(1, max(present)) if number not in present]


def missing_part_message(number: int) -> str:
    """The sentence for one part."""
    return f"part {number} of the run is missing"

"""Beginning of a recording: schemas, channels and the `/configuration` message, checked against each other."""

from __future__ import annotations

import hashlib
import io
import struct
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel

from rtloop.recording.errors import RecordingError
from rtloop.recording.file.mcap.container import DamagedChunk, pack_records, split_records
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import split_messages
from rtloop.recording.file.topics.validation import MalformedText, parse_header, require_columns

EVERY_TICK_CHANNELS = [(channel.id, channel.topic) for channel in format.channels()]
OWN_CHANNELS = (EVERY_TICK_CHANNELS, [*EVERY_TICK_CHANNELS, (format.OVERVIEW, format.OVERVIEW_TOPIC)])
"""Channels (id, topic) of a recording of every tick, and of a recording around events."""
RUN_KEYS = ("created_unix_ns", "name", "columns")
"""Header keys that are equal in all files of a run."""


def header_payload(content: bytes) -> bytes:
    """Return the header's JSON text from `content`, the unpacked first chunk of a file that rtloop wrote.

    Raises DamagedChunk if the chunk holds no header or a further message, or if its channels are unreadable or differ
    from a recording's.
    """
    messages = split_messages(content)
    if [message.channel for message in messages] != [format.CONFIGURATION]:
        raise DamagedChunk("no header")
    try:
        channels = [
            Channel.read(ReadDataStream(io.BytesIO(record)))
            for opcode, record in split_records(content)
            if opcode == Opcode.CHANNEL
        ]
    except (struct.error, ValueError, McapError):
        raise DamagedChunk("the list of MCAP channels cannot be read") from None
    if [(channel.id, channel.topic) for channel in channels] not in OWN_CHANNELS:
        raise DamagedChunk("not a recording of rtloop: the file has other MCAP channels")
    return messages[0].payload


def read_header(path: Path, payload: bytes, content: bytes | None = None) -> format.Header:
    """Parse the header `payload` of a recording; compare it with the schemas in `content`, its unpacked first chunk.

    Without `content`, the schemas are not compared; `path` is the file named in errors.
    Raises RecordingError for a newer version, a malformed header, a configuration that does not match its SHA-256, and
    columns that do not match the schemas or the axes.
    """
    try:
        header = parse_header(payload)
        digest = hashlib.sha256(header["configuration"].encode()).hexdigest()
        if header.get("configuration_sha256") != digest:
            raise MalformedText("the recorded configuration does not match its SHA-256; the file was altered")
        expected_records = pack_records([*format.schemas(header["columns"]), *format.channels()])
        if content is not None and not content.startswith(expected_records):
            raise MalformedText("the schema of the ticks does not match the recorded columns")
        require_columns(header)
    except MalformedText as reason:
        raise RecordingError(f"{path}: header of the recording: {reason}") from None
    return header

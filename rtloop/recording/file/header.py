"""The beginning of a recording: schemas, channels and the `/configuration` message, checked against each other."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtloop.recording.errors import RecordingError
from rtloop.recording.file import format
from rtloop.recording.file.checked import Malformed, header_from, require_columns
from rtloop.recording.file.chunks import Entry, Source
from rtloop.recording.file.container import MAGIC, DamagedChunk, pack_records, unpack_chunk
from rtloop.recording.file.contents import read_chunk, split_messages


def read_header(path: Path, source: Source, entries: Sequence[Entry]) -> dict[str, Any]:
    """The header of the recording. Raises RecordingError where it is another's file, a newer one, or damaged."""
    try:
        if not entries:
            raise DamagedChunk("it holds no chunk")
        content = unpack_chunk(read_chunk(source, entries[0]))
        payload = _payload(content)
    except DamagedChunk as reason:
        if format.PROFILE.encode() not in source.read(len(MAGIC), 64):
            raise RecordingError(f"{path}: an MCAP file, but not a recording of rtloop") from None
        raise RecordingError(f"{path}: the beginning of the recording is damaged ({reason})") from None
    try:
        header = header_from(payload)
        digest = hashlib.sha256(header["configuration"].encode()).hexdigest()
        if header.get("configuration_sha256") != digest:
            raise Malformed("the recorded configuration does not match its SHA-256")
        if not content.startswith(pack_records([*format.schemas(header["columns"]), *format.channels()])):
            raise Malformed("the schema of the ticks does not match the recorded columns")
        require_columns(header)
    except Malformed as reason:
        raise RecordingError(f"{path}: header of the recording: {reason}") from None
    return header


def _payload(content: bytes) -> bytes:
    for message in split_messages(content):
        if message.channel == format.CONFIGURATION:
            return message.payload
    raise DamagedChunk("it has no header")

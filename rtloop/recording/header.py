"""The beginning of a recording: schemas, channels and the `/configuration` message, checked against each other."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtloop.recording import format
from rtloop.recording.chunks import Entry, Source
from rtloop.recording.container import MAGIC, DamagedChunk, pack_records, unpack_chunk
from rtloop.recording.contents import read_chunk, split_messages
from rtloop.recording.errors import RecordingError

REQUIRED = {"columns": list, "axes": list, "rate_hz": (int, float), "created_unix_ns": int, "paced": bool}


def read_header(path: Path, source: Source, entries: Sequence[Entry]) -> dict[str, Any]:
    """The header of the recording. Raises RecordingError where it is another's file, a newer one, or damaged."""
    try:
        if not entries:
            raise DamagedChunk("it holds no chunk")
        content = unpack_chunk(read_chunk(source, entries[0]))
        header = _parse(content)
    except DamagedChunk as reason:
        if format.PROFILE.encode() not in source.read(len(MAGIC), 64):
            raise RecordingError(f"{path}: an MCAP file, but not a recording of rtloop") from None
        raise RecordingError(f"{path}: the beginning of the recording is damaged ({reason})") from None
    number = header.get("format")
    if not isinstance(number, int) or number > format.FORMAT:
        raise RecordingError(f"{path}: recording format {number} is newer than this version reads ({format.FORMAT})")
    if any(not isinstance(header.get(key), kind) for key, kind in REQUIRED.items()):
        raise RecordingError(f"{path}: the header of the recording is incomplete")
    digest = hashlib.sha256(header.get("configuration", "").encode()).hexdigest()
    if header.get("configuration_sha256") != digest:
        raise RecordingError(f"{path}: the recorded configuration does not match its SHA-256")
    expected = pack_records([*format.schemas(header["columns"]), *format.channels()])
    if not content.startswith(expected):
        raise RecordingError(f"{path}: the schema of the ticks does not match the recorded columns")
    return header


def _parse(content: bytes) -> dict[str, Any]:
    for message in split_messages(content):
        if message.channel == format.CONFIGURATION:
            try:
                header = json.loads(message.payload)
            except ValueError:
                break
            if isinstance(header, dict):
                return header
    raise DamagedChunk("it has no header")

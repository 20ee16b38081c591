"""Change a recording: rewrite it with right checksums, or flip a byte."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.recording.file.reader import Reader
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import FINAL
from rtloop.recording.file.topics.format import CONFIGURATION, EVENTS, LAW
from rtloop.recording.file.writer import Writer

Rows = np.ndarray[Any, Any]
DIGEST_BYTES = 32


def flip_byte(path: Path, place: int | None = None, target: Path | None = None) -> Path:
    """Flip a bit of one byte, by default the middle one, in place or into the file `target`. Returns its path."""
    data, target = bytearray(path.read_bytes()), target or path
    data[len(data) // 2 if place is None else place] ^= 1
    target.write_bytes(data)
    return target


def rewrite(
    source: Path,
    target: Path,
    *,
    rows: Callable[[Rows], Any] = lambda rows: None,
    law: Callable[[bytearray], Any] = lambda data: None,
    event: Callable[[dict[str, Any]], Any] = lambda event: None,
    final_event: Callable[[dict[str, Any]], Any] | None = None,
) -> Path:
    """Copy `source` to `target`; each function changes its argument in place. Returns `target`.

    `event` changes all events but the one that ends the file, which `final_event` changes.
    """
    with Reader(source) as reader:
        header = {key: value for key, value in reader.header.items() if key != "configuration_sha256"}
        writer = Writer(target, header, header["created_unix_ns"])
        writer.start_unix_ns = reader.start_unix_ns
        final_messages: list[Message] = []
        for block, messages in reader.chunks():
            if block is not None:
                block = np.ascontiguousarray(block)
                rows(block)
                writer.write_ticks(block)
            changed_messages = []
            for message in messages:
                if message.channel == EVENTS and json.loads(message.payload)["kind"] in FINAL:
                    final_messages.append(message)
                elif message.channel != CONFIGURATION:
                    changed_messages.append(_change(message, law, event))
            writer.write_messages(changed_messages)
        final = final_messages[-1]
        writer.finish(lambda _: final if final_event is None else _change(final, law, final_event))
    return target


def _change(message: Message, law: Callable[[bytearray], Any], event: Callable[[dict[str, Any]], Any]) -> Message:
    """Return a message with the change for its topic applied, and with the right digest of a snapshot."""
    if message.channel == LAW:
        data = bytearray(message.payload[DIGEST_BYTES:])
        law(data)
        return message._replace(payload=hashlib.sha256(data).digest() + data)
    if message.channel == EVENTS:
        content = json.loads(message.payload)
        event(content)
        return message._replace(payload=json.dumps(content).encode())
    return message

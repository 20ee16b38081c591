"""Forged recordings: a good file with one change and renewed checksums, so that only its meaning is wrong."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import zstandard
from mcap.records import Channel, ChunkIndex, Header, Schema, Statistics

from rtloop.engine.commands import send
from rtloop.engine.messages import Kind, message
from rtloop.kernel.memory import slot_view
from rtloop.laws.shipped import transfer
from rtloop.recording.file.mcap.container import CHUNK_HEAD, MAGIC, pack_chunk, pack_end, pack_message, pack_records
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message, split_messages
from tests.recording.law_fields import INTEGERS, snapshot_fields
from tests.recording.real_loop import TWO_AXES, RecordedRun, changed_configuration, schedule

Random = np.random.Generator
DEPTH = 100_000
LAST_LOG_TIME = 1 << 62
"""The last log time that the index gives for each chunk."""
DIGEST_BYTES = 32
TICKS, CHUNK_TICKS, SNAPSHOT_TICKS, SWAP_TICK = 600, 100, 150, 200
ODD_JSON_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 7, 255, 2**31, 2**53, 2**63, -(2**63), 2**64, 10**400),
    *(-0.0, 0.5, 1e-310, 1e308, float("nan"), float("inf"), float("-inf")),
    *("", "x", "off", "99", "1e400", "[/red]", "$x^$", "\0\x1b[2J", "\ud800", "x" * 5_000, "../x"),
    *([], {}, [1, 2], ["x", "x"], [None], {"x": {}}, [[0, 1, 2]]),
)
"""Values of a wrong type, range or text for a field of a JSON document."""
ODD_NUMBERS = (0.0, -0.0, 1.0, -1.0, 3.0, 1e-310, 1e9, 1e19, -1e19, 1e308, np.nan, np.inf, -np.inf, 0.5, 4294967296.0)
BAD_PAYLOADS = (
    *(b"", b"{", b"null", b"[]", b"\xff\xfe", b'{"tick":1}'),
    *(b"[" * DEPTH, b'{"a":' * DEPTH, b"1" * 5_000, b"\0" * 64),
)


class Forgery(NamedTuple):
    """A forged file: a description of the change, and the bytes.

    `origin`: the changed snapshot is the first one, from which a replay starts without a comparison. `renewed`: the
    checksums are right.
    """

    change: str
    data: bytes
    origin: bool = False
    renewed: bool = True


class Chunk(NamedTuple):
    """Content of a chunk and its channels in the index; ticks have none."""

    content: bytes
    channels: tuple[int, ...] = ()

    @property
    def messages(self) -> list[Message]:
        """Messages of the chunk; none for a chunk of ticks."""
        return split_messages(self.content) if self.channels else []

    def replace_messages(self, messages: list[Message]) -> Chunk:
        """Return the chunk with these messages as its content."""
        return self._replace(content=b"".join(pack_message(*message) for message in messages))


class Base(NamedTuple):
    """The parts of a good recording: header, all chunks after the first one, and record type of a tick."""

    header: dict[str, Any]
    chunks: list[Chunk]
    dtype: np.dtype[Any]

    def replace_chunk(self, place: int, chunk: Chunk) -> Base:
        """Return the recording with one chunk replaced."""
        return self._replace(chunks=[*self.chunks[:place], chunk, *self.chunks[place + 1 :]])

    def messages(self, channel: int) -> list[tuple[int, int]]:
        """Return (chunk, place in the chunk) of every message of a channel."""
        return [
            (i, j) for i, chunk in enumerate(self.chunks) for j, message in enumerate(chunk.messages)
            if message.channel == channel
        ]  # fmt: skip

    def replace_payload(self, i: int, j: int, payload: bytes) -> Base:
        """Return the recording with the payload of message `j` of chunk `i` replaced."""
        messages = self.chunks[i].messages
        messages[j] = messages[j]._replace(payload=payload)
        return self.replace_chunk(i, self.chunks[i].replace_messages(messages))

    def replace_snapshot_number(
        self, i: int, j: int, start: int, number: np.ndarray[Any, Any], length: int = 0
    ) -> Base:
        """Return the recording with a number in a snapshot replaced, and `length` bytes cut off its end."""
        data = bytearray(self.chunks[i].messages[j].payload[DIGEST_BYTES:])
        data[start : start + number.itemsize] = number.tobytes()
        data = data[: len(data) - length]
        return self.replace_payload(i, j, hashlib.sha256(data).digest() + data)


def configuration_texts() -> list[str]:
    """Return two configurations: one axis with a pre-filter, commands and a trip; two axes."""
    one_axis = changed_configuration(("# taps = [", "taps = ["), ("# [axis.prefilter]", "[axis.prefilter]"))
    entries = ((100, 'mode = "feedforward"'), (180, 'mode = "closed_loop"'),
               (300, 'reference = { kind = "sine", amplitude = 20.0, frequency_hz = 50.0 }'),
               (400, 'mode = "off"'), (450, "reset_trip = true"), (500, 'mode = "raw"'))  # fmt: skip
    return [one_axis + schedule(*entries), TWO_AXES]


def record_bases(folder: Path) -> list[Base]:
    """Record a good run of each of `configuration_texts`, and return their parts."""
    bases = []
    for number, text in enumerate(configuration_texts()):
        run = RecordedRun(folder / f"{number}.mcap", text, paced=False)
        record_run(run)
        run.session.finish("finished")
        bases.append(take_apart(run.path))
    return bases


def record_run(
    run: RecordedRun, end: int = TICKS, chunk_ticks: int = CHUNK_TICKS, snapshot_ticks: int = SNAPSHOT_TICKS
) -> None:
    """Execute and record the ticks of a run before `end` in short chunks, with a change of the controller."""
    loop, session = run.loop, run.session
    loop.take_snapshots_every(snapshot_ticks)
    with patch.object(type(session), "write_due", type(session)._write_all):
        while loop.tick < end:
            if loop.tick == SWAP_TICK:
                changed_law = loop.prepared.plan.coefficients.copy()
                slot_view(changed_law[0], "controller", transfer.COEFFICIENTS).d *= 0.9
                loop.block["staged"][: changed_law.nbytes] = np.frombuffer(changed_law.tobytes(), np.uint8)
                send(loop.block, message(Kind.LOAD_LAW, axis=0, values=[1.0]))
            loop.run(chunk_ticks)
            session.drain()
            session.write_due()


def take_apart(path: Path) -> Base:
    """Return the parts of a good recording."""
    with Reader(path) as reader:
        entries = [(entry, entry.index) for entry in reader.entries[1:] if entry.index]
        assert len(entries) == len(reader.entries) - 1
        chunks = [Chunk(reader._layout.content(entry), index.channels) for entry, index in entries]
        return Base(reader.header, chunks, format.tick_dtype(reader.columns))


def pack_file(
    base: Base,
    first: bytes | None = None,
    forge: Callable[[list[ChunkIndex]], object] = lambda index: None,
    hidden: Mapping[int, bytes] = MappingProxyType({}),
    appended: bytes = b"",
) -> bytes:
    """Pack the file with `first` as the content of its first chunk, if given; `forge` may change the index.

    `hidden` are the records that take the place of the message indexes of some chunks, `appended` those in the summary.
    """
    start = first_chunk(base.header, base.header["columns"]) if first is None else first
    compressor, index = zstandard.ZstdCompressor(level=1), []
    data = MAGIC + pack_records([Header(format.PROFILE, format.LIBRARY)])
    for number, (content, channels) in enumerate((Chunk(start, (format.CONFIGURATION,)), *base.chunks)):
        chunk, records = pack_chunk(content, 0, LAST_LOG_TIME, compressor), hidden.get(number, b"")
        places = dict.fromkeys(channels, len(data))
        size, start, end = len(chunk) - CHUNK_HEAD.size, len(data), LAST_LOG_TIME
        index.append(ChunkIndex(len(chunk), start, "zstd", size, end, len(records), places, 0, len(content)))
        data += chunk + records
    forge(index)
    repeated = [*format.schemas(base.header["columns"]), *format.channels()]
    statistics = Statistics(0, 4, {}, len(index), 0, 0, 0, 0, 3)
    return data + pack_end(0, len(data), repeated, statistics, pack_records(index) + appended)


def pack_changed_snapshot(base: Base, field: str, value: float, which: int = 0) -> bytes:
    """Pack the file with one number of snapshot number `which` replaced."""
    dtype, start = next(
        (dtype.base, start) for name, dtype, start in snapshot_fields(base.header["axes"]) if name == field
    )
    place = base.messages(format.LAW)[which]
    return pack_file(base.replace_snapshot_number(*place, start, np.array([value]).astype(dtype)))


def first_chunk(header: dict[str, Any] | bytes, columns: Any) -> bytes:
    """Pack the first chunk of a file: the schemas of `columns`, the channels and the header."""
    payload = header if isinstance(header, bytes) else json.dumps(header).encode()
    records: list[Schema | Channel] = [*format.schemas(columns), *format.channels()]
    return pack_records(records) + pack_message(format.CONFIGURATION, 0, payload)


def _choose(choices: Sequence[Any], random: Random) -> Any:
    """Return one of the choices, drawn at random."""
    return choices[int(random.integers(len(choices)))]


def forge_header(base: Base, random: Random) -> Forgery:
    """Change a field of the header, at any depth."""
    header = copy.deepcopy(base.header)
    if random.random() < 0.05:
        junk = _choose(BAD_PAYLOADS, random)
        return Forgery(f"header: {junk[:20]!r}", pack_file(base, first_chunk(junk, base.header["columns"])))
    change = _forge_json(header, random)
    if isinstance(header.get("configuration"), str) and random.random() < 0.9:
        text = header["configuration"].encode(errors="replace")
        header["configuration_sha256"] = hashlib.sha256(text).hexdigest()
    columns = header.get("columns")
    fits = isinstance(columns, list) and all(isinstance(name, str) and name.isprintable() for name in columns)
    columns = columns if fits and random.random() < 0.7 else base.header["columns"]
    return Forgery(f"header {change}", pack_file(base, first_chunk(header, columns)))


def _forge_json(document: Any, random: Random) -> str:
    """Change or delete one value of a document, in place. Returns a description."""
    path, node = [], document
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = keys[random.integers(len(keys))]
        path.append(str(key))
        inner = node[key]
        if not isinstance(inner, dict | list) or not inner or random.random() < 0.3:
            break
        node = inner
    if random.random() < 0.15:
        del node[key]
        return f"{'.'.join(path)}: deleted"
    node[key] = value = _choose(ODD_JSON_VALUES, random)
    return f"{'.'.join(path)}: {str(value)[:30]!r}"


def forge_event(base: Base, random: Random) -> Forgery:
    """Change a field of an event, its whole text, or a number in a command."""
    i, j = _choose(base.messages(format.EVENTS), random)
    event = json.loads(base.chunks[i].messages[j].payload)
    kind, choice = event["kind"], random.random()
    if choice < 0.4 and "values" in event["what"]:
        place = int(random.integers(3))
        event["what"]["values"][place] = _choose(ODD_NUMBERS, random)
        change = f"values.{place}: {event['what']['values'][place]}"
    else:
        change = _forge_json(event, random)
    payload = json.dumps(event).encode()
    if choice > 0.9:
        payload = _choose(BAD_PAYLOADS, random)
        change = f"{payload[:20]!r}"
    return Forgery(f"event {kind} {change}", pack_file(base.replace_payload(i, j, payload)))


def forge_snapshot(base: Base, random: Random) -> Forgery:
    """Change a number in a snapshot (or the same in all of them), its length, or its tick."""
    places = base.messages(format.LAW)
    chosen = places if random.random() < 0.2 else [_choose(places, random)]
    name, dtype, offset = _choose(snapshot_fields(base.header["axes"]), random)
    start = offset + int(random.integers(max(int(np.prod(dtype.shape)), 1))) * dtype.base.itemsize
    value = np.array(_choose(ODD_NUMBERS if dtype.base.kind == "f" else INTEGERS, random))
    shorter = random.random() < 0.03
    for i, j in chosen:
        base = base.replace_snapshot_number(i, j, start, value.astype(dtype.base), 8 if shorter else 0)
    place = "all" if len(chosen) > 1 else places.index(chosen[0])
    change = f"snapshot {place} {name} at {start}: {'shorter' if shorter else value}"
    return Forgery(change, pack_file(base), places[0] in chosen)


def forge_ticks(base: Base, random: Random) -> Forgery:
    """Change a number in a tick, or a field of its record."""
    i = _choose([i for i, chunk in enumerate(base.chunks) if not chunk.channels], random)
    records = np.frombuffer(base.chunks[i].content, base.dtype).copy()
    name, row = _choose(base.dtype.names or (), random), int(random.integers(len(records)))
    if base.dtype[name].kind == "f":
        value = _choose(ODD_NUMBERS, random)
        if random.random() < 0.2:  # The next double.
            value = (records[name][row : row + 1].view(np.uint64) + np.uint64(1)).view(np.float64)[0]
    else:
        value = np.array(_choose(INTEGERS, random)).astype(base.dtype[name])
    records[name][row] = value
    return Forgery(f"tick {name} of row {row}: {value}", pack_file(base.replace_chunk(i, Chunk(records.tobytes()))))


def forge_bytes(base: Base, random: Random) -> Forgery:
    """Replace, insert or remove bytes of the content of a chunk."""
    i = int(random.integers(-1, len(base.chunks)))
    content = first_chunk(base.header, base.header["columns"]) if i < 0 else base.chunks[i].content
    place, kind, new = int(random.integers(len(content))), int(random.integers(3)), random.bytes(8)
    removed = (len(new), 0, len(new))[kind]
    content = content[:place] + (b"" if kind == 2 else new) + content[place + removed :]
    change = f"chunk {i + 1}: {('bytes', 'more bytes', 'fewer bytes')[kind]} at {place}"
    if i < 0:
        return Forgery(change, pack_file(base, content))
    return Forgery(change, pack_file(base.replace_chunk(i, base.chunks[i]._replace(content=content))))


def forge_order(base: Base, random: Random) -> Forgery:
    """Remove, repeat, swap or replace a chunk."""
    chunks = list(base.chunks)
    i, j, kind = (int(random.integers(limit)) for limit in (len(chunks), len(chunks), 4))
    if kind == 0:
        del chunks[i]
    elif kind == 1:
        chunks.insert(j, chunks[i])
    else:
        chunks[i], chunks[j] = chunks[j], chunks[i if kind == 2 else j]
    change = f"chunk {i}: {('removed', 'repeated', 'swapped', 'replaced')[kind]} ({j})"
    return Forgery(change, pack_file(base._replace(chunks=chunks)))


def forge_index(base: Base, random: Random) -> Forgery:
    """Change, remove or repeat an entry of the index."""
    place, kind = int(random.integers(len(base.chunks) + 1)), int(random.integers(3))
    names = {field.name for field in fields(ChunkIndex)} - {"compression", "message_index_offsets"}
    name = _choose(sorted(names), random)
    value = int(_choose([count for count in INTEGERS if count >= 0], random))

    def forge_entry(index: list[ChunkIndex]) -> None:
        if kind == 0:
            index[place] = replace(index[place], **{name: value})
        else:
            index[place : place + 1] = [index[place]] * (kind - 1) * 2

    change = (f"{name}: {value}", "removed", "repeated")[kind]
    return Forgery(f"index {place} {change}", pack_file(base, forge=forge_entry))


def forge_damage(base: Base, random: Random) -> Forgery:
    """Flip a byte of the file, or cut the file off."""
    data = bytearray(pack_file(base))
    place = int(random.integers(8, len(data)))
    if random.random() < 0.3:
        return Forgery(f"cut off at {place}", bytes(data[:place]), renewed=False)
    data[place] ^= int(random.integers(1, 256))
    return Forgery(f"byte {place} flipped", bytes(data), renewed=False)


FORGERS: tuple[tuple[Callable[[Base, Random], Forgery], float], ...] = (
    *((forge_header, 0.2), (forge_event, 0.2), (forge_snapshot, 0.25), (forge_ticks, 0.15)),
    *((forge_bytes, 0.1), (forge_order, 0.03), (forge_index, 0.03), (forge_damage, 0.04)),
)


def forge(bases: list[Base], number: int) -> Forgery:
    """Return the forgery of a number; equal numbers give equal forgeries."""
    random = np.random.default_rng([7, number])
    base = bases[number % len(bases)]
    forgers, shares = zip(*FORGERS, strict=True)
    return forgers[int(random.choice(len(forgers), p=shares))](base, random)

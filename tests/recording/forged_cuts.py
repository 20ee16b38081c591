"""Recordings forged where a replay in spans cuts them, and the judgement of their replays with 1, 2, 3, 4 and 16 jobs.

A forgery changes chunks, index, snapshots, commands and totals of a good recording. The oracle knows from the forged
parts which ticks, commands and snapshots every reader of the file finds, hidden ones too: a recording with others than
the good one has must not be identical.
"""

from __future__ import annotations

import copy
import hashlib
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import zstandard
from mcap.records import ChunkIndex

from rtloop.errors import RtloopError
from rtloop.recording.capture.selective import SelectiveSession
from rtloop.recording.cutting.cut import cut
from rtloop.recording.file.mcap.container import pack_chunk, pack_message, split_records
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics import format
from rtloop.recording.load import load
from rtloop.recording.replay import spans
from rtloop.recording.replay.laws import NO_TRUST, recorded_laws
from rtloop.recording.replay.replay import replay
from tests.recording.forged_worker import COMMANDS, computed_bytes
from tests.recording.forging import (
    Base,
    Chunk,
    Random,
    configuration_texts,
    pack_file,
    record_run,
    take_apart,
)
from tests.recording.real_loop import RecordedRun

JOBS = (1, 2, 3, 4, 16)
TICKS, CHUNK_TICKS, SNAPSHOT_TICKS, KILL_TICK = 600, 20, 60, 360
AROUND = {"format": 2, "around": {"before_s": 0.002, "after_s": 0.002, "every_s": 0.003, "on": ["mode"]}}
DRIVE_V = 9.99
NOWHERE = 77
"""Channel that no recording has."""
EFFECTIVE = {kind: fields for kind, fields in COMMANDS.items() if kind != "reset_trip"}
"""Kinds of commands that change an output in these runs, which never trip, with the fields that the loop uses."""


class Part(NamedTuple):
    """One file of a recording: its chunks, and what a forger adds.

    `nested` are the contents of chunks that lie where the index of the file puts the message indexes of chunk number
    KEY, the header's chunk being -1; `appended` those behind the end of the data. `channels` replaces the channels of
    chunks in the index, `change_index` any other field. `cut_bytes` are missing at the end of the file.
    """

    base: Base
    nested: dict[int, bytes]
    appended: tuple[bytes, ...] = ()
    channels: dict[int, tuple[int, ...]] | None = None
    change_index: Callable[[list[ChunkIndex]], object] = lambda index: None
    cut_bytes: int = 0

    @property
    def tick_chunks(self) -> list[int]:
        """Places of the chunks of ticks."""
        return [place for place, chunk in enumerate(self.base.chunks) if not chunk.channels]

    def records(self, place: int) -> np.ndarray[Any, Any]:
        """Return a copy of the records of a chunk of ticks."""
        return np.frombuffer(self.base.chunks[place].content, self.base.dtype).copy()

    def with_chunks(self, chunks: Sequence[Chunk]) -> Part:
        """Return the file with other chunks."""
        return self._replace(base=self.base._replace(chunks=list(chunks)))

    def with_records(self, place: int, records: np.ndarray[Any, Any]) -> Part:
        """Return the file with other records in a chunk of ticks."""
        return self._replace(base=self.base.replace_chunk(place, Chunk(records.tobytes())))

    def pack(self) -> bytes:
        """Return the bytes of the file."""

        def forge(index: list[ChunkIndex]) -> None:
            for place, channels in (self.channels or {}).items():
                index[place + 1] = replace(index[place + 1], message_index_offsets=dict.fromkeys(channels, 0))
            self.change_index(index)

        nested = {place + 1: pack_record(content) for place, content in self.nested.items()}
        data = pack_file(self.base, None, forge, nested, b"".join(map(pack_record, self.appended)))
        return data[: len(data) - self.cut_bytes]


Run = tuple[Part, ...]
"""The files of a recording."""


class Contents(NamedTuple):
    """Executed or compared contents of a recording, in the order of its files: ticks, commands, snapshots."""

    ticks: list[bytes]
    commands: list[Any]
    snapshots: list[bytes]


class Original(NamedTuple):
    """A good recording, and one of the same configuration whose ticks and snapshots differ from a tick on."""

    name: str
    run: Run
    other: Run | None


def pack_record(content: bytes) -> bytes:
    """Pack a chunk record."""
    return pack_chunk(content, 0, 1 << 62, zstandard.ZstdCompressor(level=1))


def read_contents(run: Run) -> Contents:
    """Return all executed or compared contents of a recording, wherever they lie in its files."""
    contents = Contents([], [], [])
    for part in run:
        axes = len(part.base.header["axes"])
        for place in range(-1, len(part.base.chunks)):
            if place >= 0:
                _read_chunk(part.base.chunks[place].content, axes, contents)
            if place in part.nested:
                _read_chunk(part.nested[place], axes, contents)
        for content in part.appended:
            _read_chunk(content, axes, contents)
    return contents


def _read_chunk(content: bytes, axes: int, contents: Contents) -> None:
    """Add the contents of a chunk, and of a chunk within it."""
    for opcode, record in split_records(content):
        if opcode == 6:
            _read_chunk(zstandard.ZstdDecompressor().decompress(record[44:]), axes, contents)
        if opcode != 5:
            continue
        channel, payload = int.from_bytes(record[:2], "little"), record[22:]
        if channel in (format.TICKS, NOWHERE):
            contents.ticks.append(computed_bytes(payload, axes))
        elif channel == format.LAW:
            contents.snapshots.append(payload)
        elif channel == format.EVENTS and (event := json.loads(payload))["kind"] in EFFECTIVE:
            fields = {"axis": event["axis"], "value": event["what"]["values"][0]}
            contents.commands.append((event["tick"], event["kind"], *(fields[key] for key in EFFECTIVE[event["kind"]])))


def may_be_identical(run: Run, original: Contents) -> bool:
    """Whether a replay may call a recording identical: the good one's ticks and commands, each once and in order.

    Snapshots may be missing, as there is no number of them; the others must be the good ones, each once.
    """
    contents = read_contents(run)
    place = iter(original.snapshots)
    are_good = all(snapshot in place for snapshot in contents.snapshots)
    is_whole = all(part.cut_bytes < len(part.pack()) and part.cut_bytes <= _summary_bytes(part) for part in run)
    return is_whole and are_good and contents[:2] == original[:2]


def _summary_bytes(part: Part) -> int:
    """Number of bytes behind the chunks of a file."""
    data = part._replace(cut_bytes=0).pack()
    return len(data) - int.from_bytes(data[-28:-20], "little") + 13


def record_originals(folder: Path) -> list[Original]:
    """Record the good recordings: one axis, two axes, rotated, around events, cut, with a gap, a killed recorder's."""
    text, two_axes = configuration_texts()
    other_text = text.replace("at_tick = 100", "at_tick = 90")
    originals = []
    kinds: list[tuple[str, str, dict[str, Any]]] = [
        ("one axis", text, {}),
        ("two axes", two_axes, {}),
        ("rotated", text, {"rotate_s": 0.012}),
        ("around", text, {"header": AROUND}),
    ]
    for name, this_text, options in kinds:
        runs = [
            _record(folder / f"{name}-{place}.mcap", a_text, **options)
            for place, a_text in enumerate((this_text, other_text))
        ]
        originals.append(Original(name, runs[0], runs[1] if name in ("one axis", "rotated") else None))
    cut(folder / "one axis-0.mcap", 130, 500, folder / "cut.mcap")
    originals.append(Original("cut", _take_apart([folder / "cut.mcap"]), None))
    run = RecordedRun(folder / "killed.mcap", text, paced=False)
    _execute(run, KILL_TICK)
    first = run.copy_part("first.mcap.part")
    run.begin(sequence=2)
    _execute(run, TICKS)
    run.session.finish("finished")
    recover(first)
    files = _take_apart([folder / "first.mcap", folder / "killed-0002.mcap"])
    originals.append(Original("killed recorder", files, None))
    return [*originals, Original("gap", (_with_gap(originals[0].run[0]),), None)]


def _record(path: Path, text: str, **options: Any) -> Run:
    """Record a short run. Returns its files."""
    run = (SelectiveRun if "header" in options else RecordedRun)(path, text, paced=False, **options)
    _execute(run, TICKS)
    totals: dict[str, Any] = run.session.finish("finished")
    return _take_apart([Path(name) for name in totals["paths"]])


def _take_apart(paths: Sequence[Path]) -> Run:
    """Return the files of a recording, without the channels that the index may give for chunks of ticks."""
    bases = [take_apart(path) for path in paths]
    return tuple(
        Part(base._replace(chunks=[Chunk(c.content, () if c.channels == (format.TICKS,) else c.channels)
                                   for c in base.chunks]), {})
        for base in bases
    )  # fmt: skip


class SelectiveRun(RecordedRun):
    """A run that is recorded around events."""

    session_class = SelectiveSession


def _execute(run: RecordedRun, end: int) -> None:
    """Execute and record the ticks of a run before `end`."""
    record_run(run, end, CHUNK_TICKS, SNAPSHOT_TICKS)


def _with_gap(part: Part) -> Part:
    """Return the file without the ticks of two chunks before the snapshot of tick 320, with the event of the gap."""
    lost = part.tick_chunks[14:16]
    first = int(part.records(lost[0])["tick"][0])
    assert first == 280
    part = change_totals(part, lambda totals: totals.update(ticks_logged=TICKS - 40, ticks_lost=40, complete=False))
    gap = {"tick": 320, "time_ns": 0, "kind": "gap", "who": "recorder", "axis": None}
    content = json.dumps({**gap, "what": {"first_tick": first, "count": 40}}).encode()
    part = part._replace(
        base=part.base.replace_chunk(lost[0], Chunk(pack_message(format.EVENTS, 0, content), (format.EVENTS,)))
    )
    return part.with_chunks([chunk for place, chunk in enumerate(part.base.chunks) if place != lost[1]])


def double_chunk(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Write a chunk of ticks twice, one of both forged from a tick on, beside it or elsewhere."""
    part, replaced = _choose_file(run, random)
    place = _choose(part.tick_chunks, random)
    records = part.records(place)
    kind = int(random.integers(3))
    forged = _raise_drive(records, int(random.integers(len(records))))
    pair = ((forged, records), (records, forged), (records, records))[kind]
    where = place + 1 if random.random() < 0.7 else int(random.integers(len(part.base.chunks)))
    chunks = [*part.base.chunks]
    chunks[place] = Chunk(pair[0].tobytes())
    chunks.insert(where, Chunk(pair[1].tobytes()))
    return f"chunk {place} twice ({kind}), at {where}", replaced(part.with_chunks(chunks))


def move_chunk(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Swap two chunks, drop one, or write one over another."""
    part, replaced = _choose_file(run, random)
    chunks = [*part.base.chunks]
    i, j, kind = (int(random.integers(limit)) for limit in (len(chunks), len(chunks), 3))
    if kind == 0:
        chunks[i], chunks[j] = chunks[j], chunks[i]
    elif kind == 1:
        del chunks[i]
    else:
        chunks[j] = chunks[i]
    return f"chunk {i} {('swapped', 'dropped', 'over')[kind]} {j}", replaced(part.with_chunks(chunks))


def shift_border(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Move ticks over the border of two chunks, repeat or drop them there, or divide a chunk."""
    part, replaced = _choose_file(run, random)
    if len(part.tick_chunks) < 2:
        return "nothing", run
    which = int(random.integers(len(part.tick_chunks) - 1))
    left, right = part.tick_chunks[which : which + 2]
    a, b = part.records(left), part.records(right)
    count, kind = int(random.integers(1, min(len(a), len(b)))), int(random.integers(6))
    if kind == 0:  # The format allows it.
        a, b = np.concatenate([a, b[:count]]), b[count:]
    elif kind == 1:
        a = np.concatenate([a, b[:count]])
    elif kind == 2:
        a = np.concatenate([a, _raise_drive(b, 0)[:count]])
    elif kind == 3:
        a = a[:-count]
    elif kind == 4:
        b = np.concatenate([_raise_drive(a, 0)[-count:], b])
    else:
        chunks = [*part.base.chunks]
        chunks[left : left + 1] = [Chunk(a[:count].tobytes()), Chunk(a[count:].tobytes())]
        return f"chunk {left} divided", replaced(part.with_chunks(chunks))
    return f"border {left}, {right} by {count} ({kind})", replaced(part.with_records(left, a).with_records(right, b))


def change_tick(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Change the drive of one tick, or of all from there to the end of its chunk, often at a snapshot."""
    part, replaced = _choose_file(run, random)
    place = _choose(part.tick_chunks, random)
    records = part.records(place)
    near = np.flatnonzero(np.isin(records["tick"] % SNAPSHOT_TICKS, (0, 1, SNAPSHOT_TICKS - 1)))
    row = int(_choose(near, random)) if len(near) and random.random() < 0.5 else int(random.integers(len(records)))
    until = row + 1 if random.random() < 0.5 else len(records)
    forged = np.concatenate([_raise_drive(records, row)[:until], records[until:]])
    return f"ticks {records['tick'][row]:.0f} to {records['tick'][until - 1]:.0f}", replaced(
        part.with_records(place, forged)
    )


def hide_chunk(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Hide a forged or good chunk: among message indexes, in another chunk, behind the data, or by the index."""
    part, replaced = _choose_file(run, random)
    place, kind = _choose(part.tick_chunks, random), int(random.integers(7))
    records = part.records(place)
    content = _choose([_raise_drive(records, 0), records], random).tobytes()
    slow = _choose([i for i, chunk in enumerate(part.base.chunks) if chunk.channels], random)
    if kind == 0:
        part = part._replace(nested={place: content})
    elif kind == 1:
        part = part._replace(appended=(content,))
    elif kind == 2:
        chunk = part.base.chunks[slow]
        inner = _choose([content, pack_record(content)], random)
        part = part._replace(base=part.base.replace_chunk(slow, chunk._replace(content=chunk.content + inner)))
    elif kind == 3:  # The chunk is there, and the index denies it.
        channels = _choose([(format.EVENTS,), (format.OVERVIEW,), (format.CONFIGURATION,), (NOWHERE,)], random)
        part = part.with_chunks([*part.base.chunks[:place], Chunk(content), *part.base.chunks[place:]])
        part = part._replace(channels={place: channels})
    elif kind == 4:  # A chunk of messages counts as one of ticks.
        part = part._replace(channels={slow: _choose([(), (format.TICKS,)], random)})
    elif kind == 5:
        channel = int(NOWHERE).to_bytes(2, "little")
        size = part.base.dtype.itemsize
        content = b"".join(
            content[k : k + 9] + channel + content[k + 11 : k + size] for k in range(0, len(content), size)
        )
        chunks = [*part.base.chunks]
        chunks.insert(place, Chunk(content, _choose([(NOWHERE,), (format.EVENTS,), (), (format.TICKS,)], random)))
        part = part.with_chunks(chunks)
    else:
        part = part._replace(nested={slow: content})
    return f"hidden chunk {place} ({kind})", replaced(part)


def change_snapshot(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Change, repeat, drop or move a snapshot."""
    part, replaced = _choose_file(run, random)
    i, j = _choose(part.base.messages(format.LAW), random)
    message, kind = part.base.chunks[i].messages[j], int(random.integers(6))
    messages = part.base.chunks[i].messages
    data = bytearray(message.payload[32:])
    data[_choose([i for i in range(8, len(data)) if data[i]], random)] ^= 1
    forged = message._replace(payload=_digest(data))
    if kind < 4:
        messages[j : j + 1] = ((forged,), (forged, message), (message, forged), (message, message))[kind]
    else:
        del messages[j]
    part = part._replace(base=part.base.replace_chunk(i, part.base.chunks[i].replace_messages(messages)))
    if kind == 5:
        where = int(random.integers(len(part.base.chunks)))
        chunk = Chunk(pack_message(*message), (format.LAW,))
        part = part.with_chunks([*part.base.chunks[:where], chunk, *part.base.chunks[where:]])
    tick = int.from_bytes(message.payload[32:40], "little")
    return f"snapshot of tick {tick} ({kind})", replaced(part)


def graft(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Put chunks of another run, whose snapshots agree with its ticks, over those of the good one, or beside them."""
    if original.other is None:
        return "nothing", run
    file = int(random.integers(len(run)))
    part, other = run[file], original.other[file]
    count = min(len(part.base.chunks), len(other.base.chunks)) - 1
    begin = int(random.integers(count))
    end = count if random.random() < 0.3 else int(random.integers(begin + 1, count + 1))
    good, foreign = part.base.chunks[begin:end], other.base.chunks[begin:end]
    kind = int(random.integers(5))
    middle = (foreign, foreign + good, good + foreign, _alternate(good, foreign), _alternate(foreign, good))[kind]
    chunks = [*part.base.chunks[:begin], *middle, *part.base.chunks[end:]]
    return f"graft {begin} to {end} ({kind})", (*run[:file], part.with_chunks(chunks), *run[file + 1 :])


def change_event(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Repeat, drop, change or move a command, or move its message to another chunk."""
    part, replaced = _choose_file(run, random)
    commands = [
        (i, j) for i, j in part.base.messages(format.EVENTS)
        if json.loads(part.base.chunks[i].messages[j].payload)["kind"] in EFFECTIVE
    ]  # fmt: skip
    if not commands:
        return "nothing", run
    (i, j), kind = _choose(commands, random), int(random.integers(5))
    messages = part.base.chunks[i].messages
    message, event = messages[j], json.loads(messages[j].payload)
    if kind == 0:
        messages.insert(j, message)
    elif kind == 1:
        del messages[j]
    elif kind == 2:
        event["tick"] = max(event["tick"] + int(_choose([-60, -40, -1, 1, 40, 60, 10**6], random)), 0)
        messages[j] = message._replace(payload=json.dumps(event).encode())
    elif kind == 3:
        event["what"]["values"][0] = 1 - float(event["what"]["values"][0])
        messages[j] = message._replace(payload=json.dumps(event).encode())
    part = part._replace(base=part.base.replace_chunk(i, part.base.chunks[i].replace_messages(messages)))
    if kind == 4:
        del messages[j]
        part = part._replace(base=part.base.replace_chunk(i, part.base.chunks[i].replace_messages(messages)))
        where = int(random.integers(len(part.base.chunks)))
        chunk = Chunk(pack_message(*message), (format.EVENTS,))
        part = part.with_chunks([*part.base.chunks[:where], chunk, *part.base.chunks[where:]])
    return f"command at {event['tick']} ({kind})", replaced(part)


def change_claims(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Change totals of the end, or the header's claims about its ticks; leave out ticks that agree with the totals."""
    part, replaced = _choose_file(run, random)
    kind, amount = int(random.integers(4)), int(_choose([-200, -40, -1, 1, 40, 200], random))
    if kind == 0:
        key = _choose(["ticks_executed", "ticks_logged"], random)
        return f"{key} {amount:+}", replaced(change_totals(part, lambda totals: _add(totals, key, amount)))
    if kind == 1:
        key = _choose(["first_tick", "sequence", "repeats_before"], random)
        header = {**part.base.header, key: max(part.base.header.get(key, 0) + amount, 0)}
        return f"{key} {amount:+}", replaced(part._replace(base=part.base._replace(header=header)))
    if kind == 2 and len(run) > 1:  # The sum of all files stays.
        files = random.permutation(len(run))[:2]
        forged = [*run]
        for file, sign in zip(files, (1, -1), strict=True):
            forged[file] = change_totals(run[file], lambda totals, s=sign: _add(totals, "ticks_logged", s * amount))
        return f"ticks of the files {amount:+}", tuple(forged)
    count = int(random.integers(1, 5))  # As if the first chunks had never been.
    first = part.tick_chunks[min(count, len(part.tick_chunks) - 1)]
    lost = int(part.records(first)["tick"][0]) - int(part.records(part.tick_chunks[0])["tick"][0])
    chunks = [chunk for place, chunk in enumerate(part.base.chunks) if place >= first or chunk.channels]
    part = change_totals(part.with_chunks(chunks), lambda totals: _add(totals, "ticks_logged", -lost))
    return f"without its first {lost} ticks", replaced(part)


def change_container(original: Original, run: Run, random: Random) -> tuple[str, Run]:
    """Cut bytes off the end, or change, remove or repeat an entry of the index."""
    part, replaced = _choose_file(run, random)
    kind, size = int(random.integers(4)), len(part.pack())
    if kind == 0:
        return "cut off", replaced(part._replace(cut_bytes=int(random.integers(1, size))))
    if kind == 1:
        return "no index", replaced(part._replace(cut_bytes=int(random.integers(1, _summary_bytes(part)))))
    place = int(random.integers(len(part.base.chunks) + 1))

    def forge(index: list[ChunkIndex]) -> None:
        if kind == 2:
            index[place : place + 1] = [index[place]] * int(_choose([0, 2], np.random.default_rng(place)))
        else:
            index.reverse()

    return f"index {place} ({kind})", replaced(part._replace(change_index=forge))


FORGERS: tuple[Callable[[Original, Run, Random], tuple[str, Run]], ...] = (
    *(double_chunk, move_chunk, shift_border, change_tick, hide_chunk, change_snapshot, graft, change_event),
    *(change_claims, change_container),
)


def forge(originals: Sequence[Original], number: int) -> tuple[Original, str, Run]:
    """Return the forgery of a number: its original, a description and its files; equal numbers, equal forgeries.

    One forgery in four is a combination of two.
    """
    random = np.random.default_rng([11, number])
    original, run = originals[number % len(originals)], originals[number % len(originals)].run
    words = []
    for _ in range(1 + (random.random() < 0.25)):
        word, run = _choose(FORGERS, random)(original, run, random)
        words.append(word)
    return original, f"{original.name}: {', '.join(words)}", run


def _choose(choices: Sequence[Any] | np.ndarray[Any, Any], random: Random) -> Any:
    """Return one of the choices, drawn at random."""
    return choices[int(random.integers(len(choices)))]


def _choose_file(run: Run, random: Random) -> tuple[Part, Callable[[Part], Run]]:
    """Return a file of a run with ticks, and a function that returns the run with another file in its place."""
    file = _choose([place for place, part in enumerate(run) if part.tick_chunks], random)
    return run[file], lambda part: (*run[:file], part, *run[file + 1 :])


def _raise_drive(records: np.ndarray[Any, Any], row: int) -> np.ndarray[Any, Any]:
    """Return the records with a drive of DRIVE_V from `row` on."""
    records = records.copy()
    records["x_drive_v"][row:] = DRIVE_V
    return records


def _alternate(one: Sequence[Chunk], other: Sequence[Chunk]) -> list[Chunk]:
    """Return the chunks of both in turn."""
    return [chunk for pair in zip(one, other, strict=True) for chunk in pair]


def _digest(data: bytes | bytearray) -> bytes:
    """Return the payload of a snapshot."""
    return hashlib.sha256(data).digest() + bytes(data)


def _add(totals: dict[str, Any], key: str, amount: int) -> None:
    """Add to one of the totals."""
    totals[key] += amount


def change_totals(part: Part, change: Callable[[dict[str, Any]], object]) -> Part:
    """Return the file with other totals in the event that ends it, if it has one."""
    for i, j in reversed(part.base.messages(format.EVENTS)):
        event = json.loads(part.base.chunks[i].messages[j].payload)
        if "ticks_logged" in event["what"]:
            change(event["what"])
            return part._replace(base=part.base.replace_payload(i, j, json.dumps(event).encode()))
    return part


def add_command(part: Part, tick: int) -> Part:
    """Return the file with its last command repeated at another tick, before the event that ends the file."""
    i, j = next(
        (i, j) for i, j in reversed(part.base.messages(format.EVENTS))
        if json.loads(part.base.chunks[i].messages[j].payload)["kind"] in EFFECTIVE
    )  # fmt: skip
    message = part.base.chunks[i].messages[j]
    payload = json.dumps({**json.loads(message.payload), "tick": tick}).encode()
    chunk = Chunk(pack_message(*message._replace(payload=payload)), (format.EVENTS,))
    return part.with_chunks([*part.base.chunks[:-1], chunk, part.base.chunks[-1]])


def check(originals: Sequence[Original], folder: Path, number: int, processes: bool = False) -> tuple[str, bool]:
    """Replay a forgery by all numbers of jobs; with `processes`, also by the command. Returns (fault, is identical).

    The fault is "" without one.
    """
    original, change, run = forge(originals, number)
    paths = [folder / f"{number}-{file}.mcap" for file in range(len(run))]
    for path, part in zip(paths, run, strict=True):
        path.write_bytes(part.pack())
    answers = [answer(paths, jobs) for jobs in JOBS]
    if processes:
        answers += [_command_answer(paths, jobs) for jobs in JOBS]
    for path in paths:
        path.unlink()
    first = answers[0]
    is_identical = not isinstance(first, str) and first["identical"]
    if any(other != first for other in answers):
        return f"{number} ({change}): the answer depends on the jobs: {answers}", is_identical
    if is_identical and not may_be_identical(run, read_contents(original.run)):
        return f"{number} ({change}): wrongly identical", True
    return "", is_identical


def _command_answer(paths: Sequence[Path], jobs: int) -> dict[str, Any] | str:
    """Return the report of `rtloop replay`, or the message of its error; its exit code must agree with the report."""
    command = [sys.executable, "-m", "rtloop", "replay", *map(str, paths), "--json", "--jobs", str(jobs)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    report = json.loads(process.stdout)
    if "error" in report:
        assert process.returncode == 66, process
        return report["error"]
    assert process.returncode == (0 if report["identical"] else 1), process
    return report


def answer(paths: Sequence[Path], jobs: int) -> dict[str, Any] | str:
    """Return the report of a replay with `jobs` spans, which run in this process; the message of an error instead."""
    try:
        recording = load(paths)
        if jobs > 1:
            with patch.multiple(spans, LEAST_CHUNKS=1, _run_spans=_run_in_turn):
                report = spans._replay_in_spans(recording, recorded_laws(recording, NO_TRUST), jobs, None)
            if report:
                return report.as_dict()
        return replay(load(paths)).as_dict()
    except RtloopError as error:
        return str(error)


def _run_in_turn(recording: Any, laws: Any, found_spans: Sequence[spans.Span], progress: Any) -> list[Any]:
    """Stand in for the processes of `spans._run_spans`: each span has its own copy of the recording, as in a fork."""
    counts = []
    for span in found_spans:
        fork = copy.copy(recording)
        fork.problems, fork.left_out = [*recording.problems], [*recording.left_out]
        counts.append(spans._replay_span(fork, laws, span, lambda ticks: None))
    return counts

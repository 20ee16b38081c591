"""A short recording of a real law, and checks of recordings in a folder.

Ticks on the disk are counted with the MCAP project's reader, not with rtloop's.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from rtloop.engine.memory import SharedBlock
from rtloop.errors import RtloopError
from rtloop.recording.capture.session import Options, Session
from rtloop.recording.file.topics import format
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from tests.recording.real_loop import RealLoop, eventful_configuration

TICKS, SNAPSHOT_TICKS, CHUNK_BYTES = 640, 160, 1 << 14
MAGIC = b"\x89MCAP0\r\n"
"""Last bytes of a complete file."""
_TICK_FIELD = b"\x09"
"""Protobuf tag of field 1 with eight bytes: the first field of a tick's message, which holds the tick's number."""


@contextmanager
def small_chunks() -> Iterator[None]:
    """Set chunks so small that 64 ms of ticks fill several chunks, and several files of a rotated run."""
    original_bytes, format.MAX_CHUNK_BYTES = format.MAX_CHUNK_BYTES, CHUNK_BYTES
    try:
        yield
    finally:
        format.MAX_CHUNK_BYTES = original_bytes


@cache
def executed_loop() -> RealLoop:
    """Return a loop that has run TICKS ticks; each recorder gets a copy of its shared block."""
    loop = RealLoop(
        eventful_configuration().replace("at_tick = 3000", "at_tick = 200").replace("at_tick = 5000", "at_tick = 400")
    )
    loop.take_snapshots_every(SNAPSHOT_TICKS)
    loop.run(TICKS)
    return loop


@cache
def expected_rows() -> np.ndarray[Any, Any]:
    """Return the executed records (ticks, columns)."""
    return executed_loop().block.ring("ticks").slots[:TICKS].copy()


def new_block() -> SharedBlock:
    """Return a new shared block with all records that the loop published, before any recorder has read them."""
    source = executed_loop()
    block = SharedBlock.create(source.prepared.plan.sizes)
    for name in ("ticks", "snapshots", "events"):
        count = int(source.block[f"{name}_head"][0])
        for part in ("slots", "marks"):
            block[f"{name}_{part}"][:count] = source.block[f"{name}_{part}"][:count]
        block[f"{name}_head"][0] = count
    block["words"][:] = source.block["words"]
    return block


def header(**changes: Any) -> dict[str, Any]:
    """Return the header of a paced run, with changes: in a paced run a recorder tries again after a failure."""
    return {**executed_loop().header, "paced": True, **changes}


def write(path: Path, *, finished: bool = True, **options: Any) -> None:
    """Record the loop into `path`, or leave the unfinished `.part` of a killed recorder."""
    session = Session(new_block(), path, header(), Options(**{"min_free_bytes": 0, "message_index": True, **options}))
    while session.drain():
        session.write_due()
    if finished:
        assert session.finish("finished")["complete"]
        return
    session._write_all()  # the ticks that a killed recorder has flushed
    assert session._files.writer
    session._files.writer.close()


def ticks_on_disk(paths: Iterable[Path]) -> set[int]:
    """Return the ticks that the MCAP project's reader finds before the end, or the cut, of each file."""
    ticks: set[int] = set()
    for path in paths:
        with path.open("rb") as file:
            topics: dict[int, str] = {}
            try:
                for record in StreamReader(file).records:
                    if isinstance(record, Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, Message) and topics[record.channel_id] == "/ticks":
                        assert record.data[:1] == _TICK_FIELD
                        ticks.add(round(struct.unpack_from("<d", record.data, 1)[0]))
            except (EndOfFile, McapError, struct.error):
                continue
    return ticks


class Verdicts(NamedTuple):
    """Verdicts of rtloop on the files of a run: their ticks, `complete` of info, and problems that no try excuses."""

    ticks: frozenset[int]
    complete: bool
    problems: tuple[str, ...]


def ticks_in_files(paths: list[Path]) -> frozenset[int]:
    """Return the ticks that rtloop reads from finished files of one run."""
    return _verdicts(tuple((path.name, path.read_bytes()) for path in paths)).ticks if paths else frozenset()


def run_file_problems(paths: list[Path], required: set[int], complete_ticks: Iterable[int] = range(TICKS)) -> list[str]:
    """Return the problems of finished files of one run: missing `required` ticks, other bytes, a false verdict.

    Files that info calls complete must hold all of `complete_ticks`.
    """
    if not paths:
        return [f"{len(required)} flushed ticks are in no file"] if required else []
    problems = [f"{path.name}: renamed without its end" for path in paths if not path.read_bytes().endswith(MAGIC)]
    verdicts = _verdicts(tuple((path.name, path.read_bytes()) for path in paths))
    problems += verdicts.problems
    if missing := required - verdicts.ticks:
        problems.append(f"{len(missing)} flushed ticks are in no file")
    if verdicts.complete and (missing := set(complete_ticks) - verdicts.ticks):
        problems.append(f"info says complete, and {len(missing)} ticks are missing")
    return problems


@lru_cache(maxsize=256)
def _verdicts(files: tuple[tuple[str, bytes], ...]) -> Verdicts:
    """Read, summarise and replay files, given as names and bytes; the same bytes are checked only once."""
    with TemporaryDirectory() as name:
        paths = [Path(name) / file for file, _ in files]
        for path, (_, data) in zip(paths, files, strict=True):
            path.write_bytes(data)
        try:
            recording, complete, verdict = load(paths), summarise(paths).complete, replay(load(paths))
            rows, ticks = np.concatenate(list(load(paths).blocks())), recording["tick"].astype(int)
        except RtloopError as error:
            return Verdicts(frozenset(), False, (f"a finished file cannot be read: {error}",))
    problems = []
    if rows.tobytes() != expected_rows()[ticks].tobytes():
        problems.append("the rows are not those that were executed")
    if not verdict.identical or verdict.ticks != len(ticks):
        problems.append(f"replay of {len(ticks)} true ticks says {verdict}")
    return Verdicts(frozenset(ticks.tolist()), complete, tuple(problems))

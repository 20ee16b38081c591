"""A short recording of a real law, and what a folder of recordings is judged by.

Ticks on the disk are counted with the MCAP project's own reader: nothing of rtloop says what was flushed.
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
from tests.recording.real_loop import RealLoop, scheduled

TICKS, SNAPSHOT_TICKS, CHUNK_BYTES = 640, 160, 1 << 14
MAGIC = b"\x89MCAP0\r\n"
"""Ends a file that is whole."""
_TICK_FIELD = b"\x09"
"""Protobuf: field 1, eight bytes. It is the first of a tick's message, and holds its number."""


@contextmanager
def small_chunks() -> Iterator[None]:
    """Several chunks, and several files of a rotated run, in 64 ms of ticks."""
    before, format.MAX_CHUNK_BYTES = format.MAX_CHUNK_BYTES, CHUNK_BYTES
    try:
        yield
    finally:
        format.MAX_CHUNK_BYTES = before


@cache
def executed() -> RealLoop:
    """A loop that has run; what it published is copied for each recorder."""
    loop = RealLoop(scheduled().replace("at_tick = 3000", "at_tick = 200").replace("at_tick = 5000", "at_tick = 400"))
    loop.take_snapshots_every(SNAPSHOT_TICKS)
    loop.run(TICKS)
    return loop


@cache
def expected_rows() -> np.ndarray[Any, Any]:
    """The records (ticks, columns) that were executed."""
    return executed().block.ring("ticks").slots[:TICKS].copy()


def published() -> SharedBlock:
    """A new shared block with all that the loop published, and no recorder's words."""
    source = executed()
    block = SharedBlock.create(source.prepared.plan.sizes)
    for name in ("ticks", "snapshots", "events"):
        count = int(source.block[f"{name}_head"][0])
        for part in ("slots", "marks"):
            block[f"{name}_{part}"][:count] = source.block[f"{name}_{part}"][:count]
        block[f"{name}_head"][0] = count
    block["words"][:] = source.block["words"]
    return block


def header(**changes: Any) -> dict[str, Any]:
    """As of a paced run: a recorder then tries again after a failure."""
    return {**executed().header, "paced": True, **changes}


def write(path: Path, *, finished: bool = True, **options: Any) -> None:
    """Record the loop into `path`, or leave its `.part` as a recorder that was killed does."""
    session = Session(published(), path, header(), Options(**{"min_free_bytes": 0, "message_index": True, **options}))
    while session.drain():
        session.write_due()
    if finished:
        assert session.finish("finished")["complete"]
        return
    session._write_all()  # what a killed recorder has flushed
    assert session._files.writer
    session._files.writer.close()


def ticks_on_disk(paths: Iterable[Path]) -> set[int]:
    """Ticks that the MCAP project's reader finds, up to where a file is cut off."""
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
    """What rtloop says of the files of a run: their ticks, `complete` of info, and problems that do not depend on
    what was tried."""

    ticks: frozenset[int]
    complete: bool
    problems: tuple[str, ...]


def ticks_of(paths: list[Path]) -> frozenset[int]:
    """Ticks that rtloop finds in finished files of one run."""
    return _verdicts(tuple((path.name, path.read_bytes()) for path in paths)).ticks if paths else frozenset()


def problems_of(paths: list[Path], must: set[int], whole: Iterable[int] = range(TICKS)) -> list[str]:
    """What is wrong with finished files of one run: ticks of `must` that are in none, other bytes, a false verdict.

    `whole` are the ticks of which the files may say that they are complete.
    """
    if not paths:
        return [f"{len(must)} flushed ticks are in no file"] if must else []
    problems = [f"{path.name}: has its name and no end" for path in paths if not path.read_bytes().endswith(MAGIC)]
    said = _verdicts(tuple((path.name, path.read_bytes()) for path in paths))
    problems += said.problems
    if absent := must - said.ticks:
        problems.append(f"{len(absent)} flushed ticks are in no file")
    if said.complete and (absent := set(whole) - said.ticks):
        problems.append(f"info says complete, and {len(absent)} ticks lack")
    return problems


@lru_cache(maxsize=256)
def _verdicts(files: tuple[tuple[str, bytes], ...]) -> Verdicts:
    """The same bytes are judged once."""
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

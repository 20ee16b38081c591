"""A session of an unpaced run packs ticks in threads: the files are those of a session that packs in turn."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.engine.memory import Word
from rtloop.recording.capture.run_files import Options
from rtloop.recording.capture.session import Session
from rtloop.recording.capture.unpaced import UnpacedSession
from rtloop.recording.file.topics.format import chunk_rows
from rtloop.recording.load import load
from rtloop.signals import Mode
from tests.recording.disk import PLENTY_BYTES, Disk
from tests.recording.hand_made_loop import COLUMNS, HandMadeLoop, make_header, make_rows

TICKS, STEP, SNAPSHOT_TICKS = 60_000, 3_000, 1_500
ROWS = make_rows(TICKS, paced=False)
THREADS = [1, 2, 3]


def begin(loop: HandMadeLoop, path: Path, threads: int, **options: Any) -> Session:
    """A session that packs in turn without `threads`."""
    path.parent.mkdir(exist_ok=True)
    arguments = loop.block, path, make_header(paced=False), Options(**{"min_free_bytes": 0, **options})
    return UnpacedSession(*arguments, threads=threads) if threads else Session(*arguments)


def run(loop: HandMadeLoop, session: Session, begin_tick: int, end_tick: int) -> None:
    """Execute the ticks of ROWS from `begin_tick` to `end_tick`, with a command in each step, and record them."""
    for tick in range(begin_tick, end_tick, STEP):
        loop.command(tick, Mode.FEEDFORWARD)
        loop.run(ROWS[tick : tick + STEP], snapshot_every=SNAPSHOT_TICKS)
        while session.cursor < tick + STEP:
            session.drain()
            session.write_due()


def written_files(folder: Path, threads: int, **options: Any) -> dict[str, bytes]:
    """The files of a whole run by name; `threads` 0 packs in turn."""
    loop = HandMadeLoop()
    session = begin(loop, folder / f"{threads}" / "run.mcap", threads, **options)
    run(loop, session, 0, TICKS)
    totals = session.finish("finished")
    assert (totals["ticks_logged"], totals["events_lost"], totals["complete"]) == (TICKS, 0, True), totals
    return {Path(name).name: Path(name).read_bytes() for name in totals["paths"]}


@pytest.mark.parametrize(
    "options", [{}, {"message_index": True}, {"rotate_bytes": 1_000_000}, {"rotate_s": 1.3}], ids=str
)
def test_the_files_do_not_depend_on_the_threads(tmp_path: Path, options: dict[str, Any]):
    in_turn = written_files(tmp_path, 0, **options)
    assert len(in_turn) > 2 or not any(name.startswith("rotate") for name in options)
    for threads in THREADS:
        assert written_files(tmp_path, threads, **options) == in_turn
    recording = load([tmp_path / "3" / name for name in in_turn])
    assert np.concatenate(list(recording.blocks())).tobytes() == ROWS.tobytes()


@pytest.mark.parametrize("threads", [0, *THREADS])
def test_a_failed_write_loses_what_waits_behind_it_and_says_so(disk: Disk, tmp_path: Path, threads: int):
    loop = HandMadeLoop()
    session = begin(loop, tmp_path / "run.mcap", threads)
    run(loop, session, 0, 30_000)
    disk.error = errno.EIO
    run(loop, session, 30_000, 45_000)
    disk.error = None
    run(loop, session, 45_000, TICKS)
    totals = session.finish("finished")
    recording = load(totals["paths"])
    logged = np.concatenate(list(recording.blocks()))
    assert logged.tobytes() == ROWS[: len(logged)].tobytes()
    assert totals["ticks_logged"] == len(logged) == TICKS - totals["ticks_lost"]
    assert 30_000 - (threads + 1) * chunk_rows(COLUMNS) <= len(logged) <= 30_000
    assert (totals["complete"], "Input/output error" in totals["error"]) == (False, True)
    kinds = [event["kind"] for event in recording.events]
    assert kinds.count("set_mode") == TICKS // STEP - totals["events_lost"]
    assert (kinds[-1], recording.events[-1]["what"]["error"]) == ("finished", totals["error"])


def test_a_full_disk_loses_the_ticks_that_it_cannot_hold(disk: Disk, tmp_path: Path):
    loop = HandMadeLoop()
    session = begin(loop, tmp_path / "run.mcap", 2)
    run(loop, session, 0, 30_000)
    disk.longest_write_bytes = 50_000  # Too few for a chunk of ticks, enough for the end of the file.
    run(loop, session, 30_000, TICKS)
    disk.longest_write_bytes = PLENTY_BYTES
    totals = session.finish("finished")
    assert (totals["complete"], "No space left" in totals["error"]) == (False, True)
    assert len(load(totals["paths"])) == totals["ticks_logged"] == TICKS - totals["ticks_lost"] < TICKS


def test_the_block_never_counts_ticks_that_only_wait(tmp_path: Path):
    """What a replacement recorder reads there is in the file, at each step."""
    loop = HandMadeLoop()
    session = begin(loop, tmp_path / "run.mcap", 3)
    positions = []
    for tick in range(0, TICKS, STEP):
        run(loop, session, tick, tick + STEP)
        flushed, part = loop.block.load(Word.FLUSHED_TICKS), load(tmp_path / "run.mcap.part")
        snapshots, events = loop.block.load(Word.FLUSHED_SNAPSHOTS), loop.block.load(Word.FLUSHED_EVENTS)
        assert flushed == len(part)
        assert (snapshots, events) == (len(list(part.snapshots())), len(part.events))
        positions.append(flushed)
    assert max(positions) > 0
    session.finish("finished")

"""Damaged copies of a recording: all values that can be read equal the recorded ones, and each loss is reported."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.errors import RtloopError
from rtloop.interchange.export import export
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.recover import recover
from rtloop.recording.file.topics.format import TICKS
from rtloop.recording.load import load
from rtloop.recording.replay.replay import replay
from rtloop.recording.views.summary import summarise
from tests.recording.real_loop import eventful_configuration, record

CHUNK_HEAD_BYTES = 49
EXPORT_EVERY = 20
"""One in 20 damaged copies is also exported."""


class Judge:
    """Content of an intact recording (the oracle), with which damaged copies are compared."""

    def __init__(self, path: Path) -> None:
        with Reader(path) as reader:
            self.rows = np.ascontiguousarray(np.concatenate(list(reader.blocks())))
            self.events = [json.dumps(event) for event in reader.events]
            self.snapshots = {snapshot.tick: snapshot.data for snapshot in reader.snapshots()}
            self.header = reader.header
        self.summary = summarise(path)
        self.outcomes = {"refused": 0, "whole": 0, "in part": 0}

    def judge(self, path: Path, number: int) -> None:
        """Compare a damaged copy with the intact recording and count the outcome. Raises AssertionError for a fault."""
        try:
            is_complete = self._compare_content(path)
        except RtloopError as error:
            _require_path(path, error)
            self.outcomes["refused"] += 1
            return
        self.outcomes["whole" if is_complete else "in part"] += 1
        summary = summarise(path)
        assert is_complete or not summary.complete
        if summary.complete:
            assert replace(summary, recording="", parts=[]) == replace(self.summary, recording="", parts=[])
        self._check_replay(path)
        self._check_recovery(path)
        if number % EXPORT_EVERY == 0:
            self._check_export(path)

    def _compare_content(self, path: Path) -> bool:
        """Compare rows, header, events and snapshots; return whether the copy has all of them."""
        with Reader(path, tolerant=True) as reader:
            rows = self._compare_rows(reader)
            assert reader.header == self.header
            assert all(json.dumps(event) in self.events for event in reader.events)
            snapshots = {snapshot.tick: snapshot.data for snapshot in reader.snapshots()}
            assert all(self.snapshots[tick] == data for tick, data in snapshots.items())
            counts = len(rows), len(reader.events), len(snapshots)
            is_complete = counts == (len(self.rows), len(self.events), len(self.snapshots))
            assert is_complete or reader.problems
        return is_complete

    def _compare_rows(self, reader: Reader) -> np.ndarray[Any, Any]:
        """Return the rows that can be read, after a comparison of their bytes with the recorded rows."""
        rows = np.concatenate([*reader.blocks(), np.empty((0, self.rows.shape[1]))])
        assert rows.tobytes() == self.rows[rows[:, 0].astype(int)].tobytes()
        return rows

    def _check_replay(self, path: Path) -> None:
        """Replay the copy: identical, with problems reported, or refused with the file's path."""
        recording = load(path)
        try:
            report = replay(recording)
        except RtloopError as error:
            _require_path(path, error)
            return
        assert report.identical or report.problems, report

    def _check_recovery(self, path: Path) -> None:
        """Recover the copy: the result has no problems, and only recorded rows."""
        output = path.with_name("recovered.mcap")
        output.unlink(missing_ok=True)
        recover(path, output)
        with Reader(output) as reader:
            assert reader.problems == []
            self._compare_rows(reader)

    def _check_export(self, path: Path) -> None:
        """Export the copy to NPZ: the arrays hold recorded values only."""
        output = path.with_name("run.npz")
        output.unlink(missing_ok=True)
        export(path, "npz", output)
        with np.load(output) as arrays:
            ticks = arrays["tick"].astype(int)
            for index, name in enumerate(self.header["columns"]):
                assert arrays[name].tobytes() == self.rows[ticks, index].tobytes()


def _require_path(path: Path, error: RecordingError) -> None:
    """Raise AssertionError unless the error message begins with the file's path."""
    assert str(error).startswith(str(path)), error


def sensitive_offsets(path: Path) -> np.ndarray[Any, Any]:
    """Return the offsets of all bytes outside the bodies of chunks of ticks."""
    free = np.ones(path.stat().st_size, bool)
    with Reader(path) as reader:
        for entry in reader.tick_chunks:
            assert entry.index is not None
            assert TICKS in entry.index.channels or not entry.index.channels
            free[entry.offset + CHUNK_HEAD_BYTES : entry.offset + entry.length] = False
    return np.flatnonzero(free)


def judge_damaged_files(count: int, random: np.random.Generator, show_progress: Callable[[str], None]) -> None:
    """Judge `count` truncated copies and `count` copies with a changed byte, half of these outside tick data."""
    with tempfile.TemporaryDirectory() as folder:
        path = record(Path(folder) / "whole.mcap", eventful_configuration(), 25_000)[0]
        judge, intact, offsets = Judge(path), path.read_bytes(), sensitive_offsets(path)
        copy = Path(folder) / "run.mcap"
        for kind, damage in (
            ("truncations", lambda: intact[: int(random.integers(0, len(intact)))]),
            ("flipped bytes", lambda: _change_byte(intact, offsets, random)),
        ):
            judge.outcomes = dict.fromkeys(judge.outcomes, 0)
            for number in range(count):
                copy.write_bytes(damage())
                judge.judge(copy, number)
                show_progress(f"{kind} {number + 1}/{count}")
            print(f"{kind}: {count}, no traceback, no wrong number: {judge.outcomes}")


def _change_byte(intact: bytes, offsets: np.ndarray[Any, Any], random: np.random.Generator) -> bytes:
    """Return a copy of the file's bytes with one changed: at one of `offsets` or, as often, at any offset."""
    data = bytearray(intact)
    offset = int(random.choice(offsets)) if random.random() < 0.5 else int(random.integers(len(intact)))
    data[offset] ^= int(random.integers(1, 256))
    return bytes(data)

"""Damaged copies of a recording: whatever is read from one is what was recorded, or it is said what is wrong."""

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
from tests.recording.real_loop import record, scheduled

CHUNK_HEAD_BYTES = 49
EXPORTED = 20
"""One in so many is exported too."""


class Judge:
    """What may be said of a damaged copy of a recording: what was recorded, or what is wrong."""

    def __init__(self, path: Path) -> None:
        with Reader(path) as reader:
            self.rows = np.ascontiguousarray(np.concatenate(list(reader.blocks())))
            self.events = [json.dumps(event) for event in reader.events]
            self.snapshots = {one.tick: one.data for one in reader.snapshots()}
            self.header = reader.header
        self.summary = summarise(path)
        self.outcomes = {"refused": 0, "whole": 0, "in part": 0}

    def judge(self, path: Path, number: int) -> None:
        """Everything that can be read is as it was recorded; raises AssertionError otherwise."""
        try:
            whole = self._read(path)
        except RtloopError as error:
            _require_named(path, error)
            self.outcomes["refused"] += 1
            return
        self.outcomes["whole" if whole else "in part"] += 1
        summary = summarise(path)
        assert whole or not summary.complete
        if summary.complete:
            assert replace(summary, recording="", parts=[]) == replace(self.summary, recording="", parts=[])
        self._replay(path)
        self._recover(path)
        if number % EXPORTED == 0:
            self._export(path)

    def _read(self, path: Path) -> bool:
        with Reader(path, tolerant=True) as reader:
            rows = self._same(reader)
            assert reader.header == self.header
            assert all(json.dumps(event) in self.events for event in reader.events)
            snapshots = {one.tick: one.data for one in reader.snapshots()}
            assert all(self.snapshots[tick] == data for tick, data in snapshots.items())
            counts = len(rows), len(reader.events), len(snapshots)
            whole = counts == (len(self.rows), len(self.events), len(self.snapshots))
            assert whole or reader.problems
        return whole

    def _same(self, reader: Reader) -> np.ndarray[Any, Any]:
        rows = np.concatenate([*reader.blocks(), np.empty((0, self.rows.shape[1]))])
        assert rows.tobytes() == self.rows[rows[:, 0].astype(int)].tobytes()
        return rows

    def _replay(self, path: Path) -> None:
        recording = load(path)
        try:
            report = replay(recording)
        except RtloopError as error:
            _require_named(path, error)
            return
        assert report.identical or report.problems, report

    def _recover(self, path: Path) -> None:
        output = path.with_name("recovered.mcap")
        output.unlink(missing_ok=True)
        recover(path, output)
        with Reader(output) as reader:
            assert reader.problems == []
            self._same(reader)

    def _export(self, path: Path) -> None:
        output = path.with_name("run.npz")
        output.unlink(missing_ok=True)
        export(path, "npz", output)
        with np.load(output) as arrays:
            ticks = arrays["tick"].astype(int)
            for index, name in enumerate(self.header["columns"]):
                assert arrays[name].tobytes() == self.rows[ticks, index].tobytes()


def _require_named(path: Path, error: RecordingError) -> None:
    assert str(error).startswith(str(path)), error


def sensitive_places(path: Path) -> np.ndarray[Any, Any]:
    """Offsets of all bytes that are not in the body of a chunk of ticks."""
    free = np.ones(path.stat().st_size, bool)
    with Reader(path) as reader:
        for entry in reader.tick_chunks:
            assert entry.index is not None
            assert TICKS in entry.index.channels or not entry.index.channels
            free[entry.offset + CHUNK_HEAD_BYTES : entry.offset + entry.length] = False
    return np.flatnonzero(free)


def damaged_files(count: int, random: np.random.Generator, say: Callable[[str], None]) -> None:
    """`count` truncations and as many flipped bytes, half of these in headers, slow topics, indexes and the end."""
    with tempfile.TemporaryDirectory() as folder:
        path = record(Path(folder) / "whole.mcap", scheduled(), 25_000)[0]
        judge, whole, places = Judge(path), path.read_bytes(), sensitive_places(path)
        copy = Path(folder) / "run.mcap"
        for kind, damage in (
            ("truncations", lambda: whole[: int(random.integers(0, len(whole)))]),
            ("flipped bytes", lambda: _flipped(whole, places, random)),
        ):
            judge.outcomes = dict.fromkeys(judge.outcomes, 0)
            for number in range(count):
                copy.write_bytes(damage())
                judge.judge(copy, number)
                say(f"{kind} {number + 1}/{count}")
            print(f"{kind}: {count}, no traceback, no wrong number: {judge.outcomes}")


def _flipped(whole: bytes, places: np.ndarray[Any, Any], random: np.random.Generator) -> bytes:
    data = bytearray(whole)
    place = int(random.choice(places)) if random.random() < 0.5 else int(random.integers(len(whole)))
    data[place] ^= int(random.integers(1, 256))
    return bytes(data)

"""Recordings in full size: 100 killed runs, 2000 damaged files, an hour at 10 kHz. `make soak-recordings`."""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.recording.errors import RecordingError
from rtloop.recording.export import export
from rtloop.recording.format import TICKS, chunk_rows
from rtloop.recording.load import load
from rtloop.recording.reader import Reader
from rtloop.recording.recover import recover
from rtloop.recording.replay import replay
from rtloop.recording.summary import summarise
from tests.recording.hand_made_loop import COLUMNS
from tests.recording.killing import kill_a_run, recovered_ticks
from tests.recording.real_loop import ROOT, record, scheduled

LONGEST_LIFE_S = 1.5
CHUNK_HEAD_BYTES = 49
LIMITS_S = {"info": 20.0, "replay": 60.0, "plot": 60.0, "plot --html": 60.0}
LIMIT_KIB = 600 * 1024


def killed_runs(count: int, random: np.random.Generator) -> None:
    """Unpaced runs, SIGKILL at a random moment; all recover and replay, at most a chunk and the lag are missing."""
    lags, unwritten, ticks = [], [], []
    for number in range(count):
        with tempfile.TemporaryDirectory() as folder:
            killed = kill_a_run(Path(folder), random.uniform(0.0, LONGEST_LIFE_S), "--unpaced")
            ticks.append(recovered_ticks(killed))
        lags.append(killed.executed - killed.taken)
        unwritten.append(killed.taken - ticks[-1])
        assert 0 <= unwritten[-1] <= chunk_rows(COLUMNS), killed
        _say(f"killed runs {number + 1}/{count}")
    print(f"killed runs: {count}, all recovered and identical; ticks {min(ticks)} … {max(ticks)}")
    print(f"  recorder's lag in ticks: median {statistics.median(lags):.0f}, largest {max(lags)}")
    print(f"  taken but not yet written: median {statistics.median(unwritten):.0f}, largest {max(unwritten)} "
          f"(a chunk: {chunk_rows(COLUMNS)})")  # fmt: skip


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
        except RecordingError as error:
            _require_named(path, error)
            self.outcomes["refused"] += 1
            return
        self.outcomes["whole" if whole else "in part"] += 1
        summary = summarise(path)
        assert whole or not summary["complete"]
        if summary["complete"]:
            assert {**summary, "recording": 0, "parts": 0} == {**self.summary, "recording": 0, "parts": 0}
        self._replay(path)
        self._recover(path)
        if number % 20 == 0:
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
        except RecordingError as error:
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
            assert TICKS in entry.index.message_index_offsets or not entry.index.message_index_offsets
            free[entry.offset + CHUNK_HEAD_BYTES : entry.offset + entry.length] = False
    return np.flatnonzero(free)


def damaged_files(count: int, random: np.random.Generator) -> None:
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
                _say(f"{kind} {number + 1}/{count}")
            print(f"{kind}: {count}, no traceback, no wrong number: {judge.outcomes}")


def _flipped(whole: bytes, places: np.ndarray[Any, Any], random: np.random.Generator) -> bytes:
    data = bytearray(whole)
    place = int(random.choice(places)) if random.random() < 0.5 else int(random.integers(len(whole)))
    data[place] ^= int(random.integers(1, 256))
    return bytes(data)


def one_hour(folder: Path) -> None:
    """Time and memory of the commands on a recording of 36 million ticks."""
    run = _measured("run", ROOT / "deploy" / "paper.toml", "--unpaced", "--duration", "3600", "--out", folder, "--json")
    path = next(folder.glob("*.mcap"))
    print(f"an hour at 10 kHz: {path.stat().st_size / 2**30:.2f} GiB, made in {run[0]:.0f} s")
    for name, limit_s in LIMITS_S.items():
        command, *options = name.split()
        out = ["--out", folder / "picture"] if command == "plot" else []
        seconds, kib = _measured(command, path, *options, *out)
        print(f"  {name}: {seconds:.1f} s ({3600 / seconds:.0f} × real time), {kib / 1024:.0f} MiB")
        assert seconds <= limit_s
        assert kib <= LIMIT_KIB
    path.unlink()


def _measured(*arguments: Any) -> tuple[float, int]:
    """Wall clock in s and largest resident set in KiB of a command."""
    script = (
        "import resource, subprocess, sys\n"
        "code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)\n"
        "print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    began = time.monotonic()
    command = [sys.executable, "-c", script, sys.executable, "-m", "rtloop", *map(str, arguments)]
    code, kib = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert code == "0", arguments
    return time.monotonic() - began, int(kib)


def _say(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{text} ", end="", file=sys.stderr)


def main() -> None:
    """All parts, or those asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=["killed", "damaged", "hour", []], default=[])
    parser.add_argument("--killed", type=int, default=100)
    parser.add_argument("--damaged", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    random = np.random.default_rng(given.seed)
    parts: dict[str, Callable[[], None]] = {
        "killed": lambda: killed_runs(given.killed, random),
        "damaged": lambda: damaged_files(given.damaged, random),
    }
    for name, part in parts.items():
        if name in (given.parts or parts):
            part()
    if "hour" in (given.parts or ["hour"]):
        with tempfile.TemporaryDirectory() as folder:
            one_hour(Path(folder))


if __name__ == "__main__":
    main()

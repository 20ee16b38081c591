"""A loop made by hand: a shared block that tests fill through `claim` and `publish`, and the recorder's process."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.configuration.laws import DEFAULT_LAWS
from rtloop.engine.memory import ProcessState, SharedBlock, Sizes, Word
from rtloop.engine.messages import Kind, Origin, message
from rtloop.engine.ring import claim, publish
from rtloop.laws.registry import law_layout
from rtloop.recording.file.topics.contents import Message, event_message
from rtloop.recording.file.topics.events import event_from_message, recorder_event
from rtloop.recording.file.topics.format import LAW, chunk_rows
from rtloop.recording.file.writer import Writer
from rtloop.signals import (
    DRIVE,
    ERROR,
    POSITION,
    REFERENCE,
    Flag,
    Mode,
    axis_column,
    column_names,
)

RATE_HZ = 10_000.0
AXES = ["x"]
OBSERVED = ["x_true_position_um", "x_hysteresis_um"]
COLUMNS = column_names(AXES, OBSERVED)
SNAPSHOT_BYTES = 200
START_UNIX_NS = 1_763_680_000_000_000_000
TIMEOUT_S = 60.0
SLACK = 20_000
"""Ticks by which a loop may be ahead of its recorder in `RecorderProcess.record`."""


def make_rows(count: int, *, first: int = 0, paced: bool = True, seed: int = 1) -> np.ndarray[Any, Any]:
    """Return rows (count, columns) that look like a closed loop on a noisy stage."""
    random = np.random.default_rng(seed)
    rows = np.zeros((count, len(COLUMNS)))
    tick = np.arange(first, first + count)
    rows[:, 0] = tick
    rows[:, 1] = tick * 1e5
    rows[:, 2:7] = random.integers(20, 400, (count, 5)) / 1000.0 if paced else np.nan
    rows[:, 9] = Mode.CLOSED_LOOP
    reference = 25.0 * np.sin(2 * np.pi * 10.0 * tick / RATE_HZ)
    volts = np.round((reference / 10.0 + random.normal(0, 4e-4, count)) * 3276.8) / 3276.8
    rows[:, axis_column(0, 0)] = volts
    rows[:, axis_column(0, POSITION)] = volts * 10.0
    rows[:, axis_column(0, REFERENCE)] = reference
    rows[:, axis_column(0, ERROR)] = reference - volts * 10.0
    for column in (axis_column(0, DRIVE - 2), axis_column(0, DRIVE - 1), axis_column(0, DRIVE)):
        rows[:, column] = (reference + 0.3 * rows[:, axis_column(0, ERROR)]) / 12.3
    rows[:, -2] = reference + random.normal(0, 0.005, count)
    rows[:, -1] = 1.1 * rows[:, -2]
    return rows


def make_header(**changes: Any) -> dict[str, Any]:
    """Return a recording's header as the supervisor writes it, with `changes`."""
    return {
        "format": 1,
        "name": "test",
        "created_unix_ns": START_UNIX_NS - 1_000_000,
        "axes": AXES,
        "observed": OBSERVED,
        "columns": list(COLUMNS),
        "rate_hz": RATE_HZ,
        "paced": True,
        "ticks_expected": None,
        "configuration": "[loop]\nrate_hz = 10000.0\n# µ\n",
        "law": json.loads(json.dumps(law_layout(DEFAULT_LAWS).description())),
        "driver": {"kind": "sim"},
        "realtime": {"scheduler": "other", "priority": 0, "mlock": False, "affinity": [0], "kernel": "test"},
        "versions": {},
        "host": {},
        **changes,
    }


def snapshot(tick: int) -> np.ndarray[Any, Any]:
    """Return a snapshot of SNAPSHOT_BYTES: the tick, then random bytes that depend on the tick."""
    data = np.random.default_rng(tick).integers(0, 256, SNAPSHOT_BYTES, dtype=np.uint8)
    data[:8] = np.frombuffer(tick.to_bytes(8, "little"), np.uint8)
    return data


def write_recording(path: Path, rows: np.ndarray[Any, Any], **header: Any) -> Path:
    """Write a recording with the Writer alone: a snapshot and an event before each chunk of ticks. Returns `path`."""
    header = make_header(**header)
    writer = Writer(path, header, header["created_unix_ns"])
    writer.start_unix_ns = START_UNIX_NS
    step = min(chunk_rows(header["columns"]), 1_000)
    for start in range(0, len(rows), step):
        block = rows[start : start + step]
        tick, time_ns = int(block[0, 0]), int(block[0, 1])
        data = snapshot(tick).tobytes()
        record = message(Kind.SET_MODE, tick=tick, values=[Mode.CLOSED_LOOP])[0]
        event = event_message(event_from_message(record, AXES, time_ns), START_UNIX_NS)
        log_time = START_UNIX_NS + time_ns
        writer.write_messages([Message(LAW, log_time, hashlib.sha256(data).digest() + data), event])
        writer.write_ticks(block)

    writer.finish(lambda logged: final_message(len(rows), logged))
    return path


def final_message(executed: int, logged: int) -> Message:
    """Return the event that ends a recording of `logged` of `executed` ticks."""
    totals = {"ticks_executed": executed, "ticks_logged": logged, "ticks_lost": executed - logged, "events_lost": 0}
    details = {**totals, "result": "finished", "complete": executed == logged}
    return event_message(recorder_event("finished", executed, 0, details), START_UNIX_NS)


class HandMadeLoop:
    """Writer of the rings of a shared block."""

    def __init__(self, rate_hz: float = RATE_HZ) -> None:
        self.block = SharedBlock.create(Sizes(len(COLUMNS), len(AXES), rate_hz, SNAPSHOT_BYTES, 1))
        os.set_inheritable(self.block.fd, True)
        self.block.store(Word.START_UNIX_NS, START_UNIX_NS)
        self.block.store(Word.LOOP_STATE, ProcessState.RUNNING)

    def put(self, ring_name: str, payload: Any) -> None:
        """Publish `payload` in the next slot of a ring."""
        ring = self.block.ring(ring_name)
        position = np.uint64(ring.head[0])
        ring.slots[claim(ring, position)] = payload
        publish(ring, position)

    def run(self, rows: np.ndarray[Any, Any], *, snapshot_every: int = 10_000, slack: int | None = None) -> None:
        """Publish rows as ticks, with snapshots between them; wait while the recorder is over `slack` ticks behind."""
        for row in rows:
            tick = int(row[0])
            if tick % snapshot_every == 0:
                self.put("snapshots", snapshot(tick))
            while slack is not None and tick - self.cursor > slack:
                time.sleep(0.001)
            self.put("ticks", row)

    @property
    def cursor(self) -> int:
        """Number of ticks that the recorder has taken."""
        return self.block.load(Word.RECORDER_CURSOR)

    def command(self, tick: int, mode: Mode) -> None:
        """Publish the event of a change of mode."""
        self.put("events", message(Kind.SET_MODE, tick=tick, origin=Origin.SCHEDULE, values=[mode])[0])

    def trip(self, tick: int) -> None:
        """Publish the event of a trip."""
        causes = Flag.TRIP_POSITION | Flag.TRIP_STALE
        self.put("events", message(Kind.TRIPPED, tick=tick, axis=0, origin=Origin.LOOP, values=[causes, 1.5])[0])

    def end(self, state: ProcessState = ProcessState.FINISHED) -> None:
        """Store the final state of the loop."""
        self.block.store(Word.LOOP_STATE, state)


class RecorderProcess:
    """The real recorder in a separate process, on the shared block of a hand-made loop."""

    def __init__(self, loop: HandMadeLoop, *, prefix: tuple[str, ...] = ()) -> None:
        self.loop = loop
        command = [*prefix, sys.executable, "-m", "rtloop.recording.capture.recorder", "--fd", str(loop.block.fd)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, pass_fds=[loop.block.fd]
        )
        self.wait_for_state(ProcessState.READY)

    def __enter__(self) -> RecorderProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def start(self, path: Path, header: dict[str, Any] | None = None, **options: Any) -> None:
        """Give the recorder its order: path, header and options of the recording."""
        order = {"path": str(path), "header": header or make_header(), "options": {"min_free_bytes": 0, **options}}
        assert self.process.stdin
        self.process.stdin.write(json.dumps(order).encode() + b"\n")
        self.process.stdin.flush()

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Wait for `condition`; raise AssertionError if the recorder ends or TIMEOUT_S pass."""
        deadline_s = time.monotonic() + TIMEOUT_S
        while not condition():
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < deadline_s, "the recorder does not answer"
            time.sleep(0.005)

    def wait_for_state(self, state: ProcessState) -> None:
        """Wait until RECORDER_STATE is `state`."""
        self.wait_until(lambda: self.loop.block.load(Word.RECORDER_STATE) == state)

    def wait_for_ticks(self, count: int) -> None:
        """Wait until the recorder has taken `count` ticks."""
        self.wait_until(lambda: self.loop.block.load(Word.RECORDER_CURSOR) == count)

    def record(self, path: Path, rows: np.ndarray[Any, Any], **options: Any) -> tuple[int, dict[str, Any]]:
        """Record `rows` of a whole run in virtual time, with options for `start`. Returns (exit code, totals)."""
        self.start(path, make_header(paced=False), **options)
        self.loop.run(rows, slack=SLACK)
        return self.end()

    def end(self, state: ProcessState = ProcessState.FINISHED) -> tuple[int, dict[str, Any]]:
        """End the loop. Returns (exit code, totals)."""
        self.loop.end(state)
        return self.result()

    def close_orders(self) -> None:
        """Close stdin of the recorder, as a supervisor that ends."""
        assert self.process.stdin
        self.process.stdin.close()
        self.process.stdin = None

    def result(self) -> tuple[int, dict[str, Any]]:
        """Wait for the recorder's end. Returns (exit code, totals); stderr must be empty."""
        out, err = self.process.communicate(timeout=TIMEOUT_S)
        assert err == b""
        return self.process.returncode, json.loads(out)

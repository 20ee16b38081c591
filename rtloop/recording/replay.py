"""Re-execution of a recording: recorded inputs, references and commands through the same compiled loop.

Coefficients and state come from the recording's binary snapshots, never from its configuration text. Every output of
every tick is compared in bytes, and so is the law's whole state wherever a snapshot was taken. After a gap the
replay goes on from the next snapshot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rtloop import signals
from rtloop.engine.messages import MESSAGE, Kind
from rtloop.law.layout import layout_description, split_snapshot
from rtloop.recording.errors import RecordingError
from rtloop.recording.events import message_of
from rtloop.recording.load import Recording
from rtloop.recording.reader import Snapshot
from rtloop.recording.rerun import SLICE_TICKS, Law, Rerun
from rtloop.signals import Flag

MEASURED = (signals.LATENESS, signals.READ, signals.LAW, signals.WRITE, signals.EXEC)
"""Columns that a clock made and that no output depends on."""
REPLAYED = (Kind.SET_MODE, Kind.RESET_TRIP, Kind.STOP)
Progress = Callable[[int], None]


@dataclass
class ReplayReport:
    """`ticks` compared; `unverified` ticks before a snapshot or after a gap; the first difference, if any."""

    ticks: int = 0
    unverified: int = 0
    gaps: list[dict[str, int]] = field(default_factory=list)
    snapshots: int = 0
    first_difference: dict[str, Any] | None = None

    @property
    def identical(self) -> bool:
        """At least one tick was compared and none differed."""
        return self.ticks > 0 and self.first_difference is None

    def as_dict(self) -> dict[str, Any]:
        """The object of `rtloop replay --json`."""
        return {
            "ticks": self.ticks,
            "identical": self.identical,
            "first_difference": self.first_difference,
            "unverified": self.unverified,
            "gaps": self.gaps,
            "snapshots_compared": self.snapshots,
        }


def replay(recording: Recording, progress: Progress | None = None) -> ReplayReport:
    """Replay up to the first difference. Raises RecordingError for a recording of another layout, or without a law."""
    return _Replay(recording, progress).run()


def check_layout(recording: Recording) -> None:
    """Raise RecordingError where this version's law lays out its coefficients and state otherwise."""
    if recording.header.get("law", {}).get("sha256") != layout_description()["sha256"]:
        version = recording.header.get("versions", {}).get("rtloop", "unknown")
        raise RecordingError(
            f"{recording.paths[0]}: recorded by rtloop {version}, whose law is laid out differently; replay it with "
            "that version"
        )


def recorded_commands(recording: Recording, axes: list[str]) -> np.ndarray[Any, Any]:
    """The commands that took effect, as a schedule; those for references are not needed, whose samples are inputs."""
    commands = [message_of(event, axes) for event in recording.events]
    parts = [command for command in commands if command is not None and command["kind"][0] in REPLAYED]
    return np.concatenate([np.zeros(0, MESSAGE), *parts])


class _Replay:
    def __init__(self, recording: Recording, progress: Progress | None) -> None:
        check_layout(recording)
        self._recording, self._progress = recording, progress
        self._axes: list[str] = recording.header["axes"]
        self._commands = recorded_commands(recording, self._axes)
        self._compared = [i for i in range(len(recording.columns)) if i not in MEASURED]
        self._snapshots: Iterator[Snapshot] = iter(recording.snapshots())
        self._next: Snapshot | None = next(self._snapshots, None)
        self._rerun: Rerun | None = None
        self._report = ReplayReport()

    def run(self) -> ReplayReport:
        expected: int | None = None
        for block in self._recording.blocks():
            breaks = np.flatnonzero(np.diff(block[:, signals.TICK]) != 1) + 1
            for rows in np.split(block, breaks):
                first = int(rows[0, signals.TICK])
                if expected is not None and first != expected:
                    self._report.gaps.append({"first_tick": expected, "count": first - expected})
                    self._rerun = None
                expected = first + len(rows)
                self._consume(rows)
                if self._report.first_difference:
                    return self._report
            if self._progress:
                self._progress(self._report.ticks)
        if not self._report.ticks:
            raise RecordingError(
                f"{self._recording.paths[0]}: holds no tick after a snapshot of the law to replay from"
            )
        return self._report

    def _consume(self, rows: np.ndarray[Any, Any]) -> None:
        """Replay consecutive rows, in stretches that end where a snapshot lies."""
        while len(rows) and not self._report.first_difference:
            tick = int(rows[0, signals.TICK])
            while self._next is not None and self._next.tick < tick:
                self._next = next(self._snapshots, None)
            if self._next is not None and self._next.tick == tick:
                self._meet(self._next)
                self._next = next(self._snapshots, None)
                if self._report.first_difference:
                    return
            until = tick + len(rows) if self._next is None else self._next.tick
            count = min(len(rows), until - tick, SLICE_TICKS)
            if self._rerun is None:
                self._report.unverified += count
            else:
                self._compare(self._rerun, rows[:count])
            rows = rows[count:]

    def _meet(self, snapshot: Snapshot) -> None:
        """Compare the law's state with a snapshot, or start from it."""
        tick, coefficients, axes, state = split_snapshot(snapshot.data, len(self._axes))
        if self._rerun is None:
            law = Law(coefficients, axes, state)
            self._rerun = Rerun(self._recording.header, law, self._commands, tick)
            return
        self._report.snapshots += 1
        if self._rerun.law_bytes() != snapshot.data[8:]:
            self._report.first_difference = {"tick": tick, "signal": "law state", "recorded": None, "replayed": None}

    def _compare(self, rerun: Rerun, rows: np.ndarray[Any, Any]) -> None:
        replayed = rerun.execute(rows)
        count = len(replayed)
        recorded = rows[:count].copy()
        for table in (recorded, replayed):
            overruns = (table[:, signals.FLAGS].astype(np.int64) & ~int(Flag.OVERRUN)).astype(np.float64)
            table[:, signals.FLAGS] = overruns
        same = recorded.view(np.uint64) == replayed.view(np.uint64)
        same = same[:, self._compared]
        self._report.ticks += count
        if same.all() and count == len(rows):
            return
        if same.all():
            first, signal, values = count, "end of the run", (None, None)
        else:
            first = int(np.argmin(same.all(axis=1)))
            column = self._compared[int(np.argmin(same[first]))]
            signal = self._recording.columns[column]
            values = float(recorded[first, column]), float(replayed[first, column])
        tick = int(rows[first, signals.TICK])
        self._report.first_difference = {"tick": tick, "signal": signal, "recorded": values[0], "replayed": values[1]}

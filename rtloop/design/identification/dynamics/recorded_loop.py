"""Longest part of a recording in closed loop, and the external signals that excited the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from rtloop.design.identification.axis_recording import UnsuitableData, select_axis, shifted_rows
from rtloop.design.identification.dynamics.excitation import LoopExcitation
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.foundation.arrays import Real
from rtloop.recording.load import load
from rtloop.signals import Flag, Mode

State = Literal["auto", "open", "closed"]
EXTERNAL_SIGNALS = ("reference_um", "feed_um")
LIMITING_FLAGS = Flag.COMMAND_LIMITED | Flag.DRIVE_LIMITED | Flag.SLEW_LIMITED | Flag.RAMPING


@dataclass(frozen=True)
class RecordedLoop:
    """Longest part of a recording without interruption in closed loop: ticks `start` … `end` − 1.

    `external` (k, all ticks of the recording) are the external signals, `names` their names.
    In an imported recording whose positions move by a row (`shifted_rows`), tick 0 is the second row of the file.
    """

    start: int
    end: int
    names: tuple[str, ...]
    external: Real
    first_limited_tick: int | None
    """First tick of this part at which a limit or a ramp kept the command from the plant; None if there is none."""

    def excitation(self, recording: Excitation) -> LoopExcitation:
        """Return ticks `start` … `end` − 1 of `recording`, which has all ticks, with the external signals."""
        ticks = slice(self.start, self.end)
        return LoopExcitation(
            recording.name,
            recording.input[ticks],
            recording.position_um[ticks],
            recording.period_s,
            self.external[:, ticks],
        )

    def require_commands_obeyed(self, name: str) -> None:
        """Raise UnsuitableData if a limit or a ramp changed the command in ticks `start` … `end` − 1, so that the plant
        received a different one. `name` names the recording.
        """
        if self.first_limited_tick is not None:
            raise UnsuitableData(
                f"{name}: a limit or a ramp changed the command at tick {self.first_limited_tick} before it reached "
                "the plant; use --input drive or --input hysteresis"
            )


def find_closed_loop(
    path: Path, axis: str | None = None, state: State = "auto", names: Sequence[str] = ()
) -> RecordedLoop | None:
    """Return the longest part of a recording in closed loop; None for an open loop.

    `state` says whether the loop was "open" or "closed"; for "auto", the recorded mode does. With "closed" and no tick
    recorded in closed loop, all ticks count. `names` are the external signals, by default the reference and the feed of
    `axis`. Raises RecordingError for a bad file and, without `names`, as `select_axis`; UnsuitableData if the recording
    lacks one of `names`, or without `names` both of the default signals.
    """
    recording = load(path)
    closed = recording["mode"] == Mode.CLOSED_LOOP if "mode" in recording else np.zeros(0, dtype=bool)
    if state == "open" or (state == "auto" and not np.any(closed)):
        return None
    expected = tuple(names) or tuple(f"{select_axis(recording, axis, path)}_{name}" for name in EXTERNAL_SIGNALS)
    present = tuple(name for name in expected if name in recording)
    if not present or (names and len(present) < len(expected)):
        missing = ", ".join(name for name in expected if name not in recording)
        raise UnsuitableData(
            f"{path}: no external excitation found, because the recording has no {missing}; use --outside SIGNAL for "
            "each signal that excited the loop from outside"
        )
    skipped = shifted_rows(recording)
    external, closed = np.array(recording.read(*present))[:, skipped:], closed[skipped:]
    start, end = _longest_closed(closed) if np.any(closed) else (0, external.shape[1])
    flags = recording["flags"][skipped:] if "flags" in recording else np.zeros(external.shape[1])
    return RecordedLoop(start, end, present, external, _first_limited_tick(flags, start, end))


def _first_limited_tick(flags: Real, start: int, end: int) -> int | None:
    """Return the first tick from `start` on, before `end`, whose flags show an active limit or a ramp; None if there is
    none. `flags` (ticks,) has the flags of all ticks.
    """
    limited = np.flatnonzero(flags[start:end].astype(np.int64) & int(LIMITING_FLAGS))
    return start + int(limited[0]) if limited.size else None


def _longest_closed(closed: Real) -> tuple[int, int]:
    """Return first tick and last tick + 1 of the first longest run of True in `closed`, which has at least one True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], closed, [False]]).astype(np.int8))).reshape(-1, 2)
    start, end = edges[np.argmax(np.diff(edges, axis=1))]
    return int(start), int(end)

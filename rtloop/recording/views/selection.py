"""Select signals and ticks of a recording by name, by time and by every nth tick."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from rtloop.recording.errors import RecordingError
from rtloop.recording.file.reader import Rows
from rtloop.recording.recorded_signals import RecordedSignals
from rtloop.signals import COMMON_SIGNALS, DEADLINE, TICK

REQUIRED_SIGNALS = (COMMON_SIGNALS[TICK].name, COMMON_SIGNALS[DEADLINE].name)
"""Signals that every selection includes: they identify the ticks."""


@dataclass(frozen=True)
class Selection:
    """Selected signals and ticks. `signals` are names or patterns such as `x_*`; () selects all.

    `start_s` and `end_s`, both included, count from the start of the run. Of these ticks, the first is taken, and those
    whose number is a multiple of `every` above it.
    """

    signals: tuple[str, ...] = ()
    start_s: float = 0.0
    end_s: float = math.inf
    every: int = 1

    def __post_init__(self) -> None:
        """Raise RecordingError for an `every` below 1."""
        if self.every < 1:
            raise RecordingError(f"every: {self.every}; allowed: a whole number of ticks, 1 or more")

    def selected_names(self, recording: RecordedSignals) -> tuple[str, ...]:
        """Names of selected and required signals, in recorded order. Raises RecordingError if a pattern fits none."""
        if not self.signals:
            return recording.columns
        for pattern in self.signals:
            if not any(fnmatchcase(name, pattern) for name in recording.columns):
                available = ", ".join(recording.columns)
                raise RecordingError(f"{recording.paths[0]}: no signal {pattern!r}; allowed: {available}")
        patterns = (*REQUIRED_SIGNALS, *self.signals)
        return tuple(name for name in recording.columns if any(fnmatchcase(name, pattern) for pattern in patterns))

    def read_blocks(self, recording: RecordedSignals, names: Sequence[str]) -> Generator[Rows]:
        """Yield arrays (n, names) of the selected ticks, ascending.

        Raises RecordingError if a limited time span holds no tick.
        """
        is_everything = self.start_s <= 0.0 and math.isinf(self.end_s)
        columns = ["tick", *names]
        has_ticks, first = False, 0.0
        for rows in (
            recording.blocks(columns) if is_everything else recording.between(columns, self.start_s, self.end_s)
        ):
            if not has_ticks and len(rows):
                has_ticks, first = True, rows[0, 0]
            selected = rows if self.every == 1 else rows[(rows[:, 0] - first) % self.every == 0]
            if len(selected):
                yield selected[:, 1:]
        if not has_ticks and not is_everything:
            until = " on" if math.isinf(self.end_s) else f" to {self.end_s:g} s"
            raise RecordingError(f"{recording.paths[0]}: holds no tick from {self.start_s:g} s{until}")


ALL_SIGNALS = Selection()

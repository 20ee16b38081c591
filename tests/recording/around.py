"""A real law in virtual time, recorded around events, and the same run recorded whole to hold it against."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.recording.capture.selective import SelectiveSession
from tests.recording.disk import Recorded
from tests.recording.real_loop import record, rows_of, scheduled

SECOND = 10_000
"""Ticks, from snapshot to snapshot."""
TICKS = 20 * SECOND
BEFORE_S, AFTER_S = 1.2, 1.5
TRIP, STEP = 9_027, 113_456
"""Ticks of the trip, and of a change to a reference that saturates."""


def text() -> str:
    """A trip in the first second; ten seconds later another reference, then a mode and back."""
    later = [
        (STEP, 'reference = { kind = "sine", amplitude = 27.0, frequency_hz = 3.0 }'),
        (STEP + 4_000, 'reference = { kind = "sine", amplitude = 5.0, frequency_hz = 3.0 }'),
        (17 * SECOND + 5, 'mode = "feedforward"'),
    ]
    return scheduled() + "".join(f"\n[[schedule]]\nat_tick = {tick}\n{what}\n" for tick, what in later)


def around(*on: str, **changes: Any) -> dict[str, Any]:
    """What a header says."""
    return {"before_s": BEFORE_S, "after_s": AFTER_S, "every_s": 1.0, "on": list(on)} | changes


class Selected(Recorded):
    """The run, recorded around events as a paced one, or as it is in virtual time."""

    kind = SelectiveSession

    def __init__(self, path: Path, said: dict[str, Any], *, paced: bool = False, **options: Any) -> None:
        super().__init__(path, text(), {"format": 2, "around": said}, paced=paced, **options)

    def whole(self, tick: int = TICKS) -> dict[str, Any]:
        """The totals of all of it."""
        self.run_to(tick)
        return self.end()


def recorded_whole(folder: Path) -> np.ndarray[Any, Any]:
    """Every tick (TICKS, columns)."""
    return rows_of(record(folder / "whole.mcap", text(), TICKS))


def kept_seconds(hits: np.ndarray[Any, Any], count: int, first: Callable[[int], bool] = lambda k: k == 0) -> list[int]:
    """Which of `count` seconds are to be kept around ticks (n,): those that reach into what lies around one."""
    low, high = hits - round(BEFORE_S * SECOND), hits + round(AFTER_S * SECOND)
    return [k for k in range(count) if first(k) or np.any((k * SECOND <= high) & ((k + 1) * SECOND > low))]

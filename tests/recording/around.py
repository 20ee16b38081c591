"""A real law in virtual time, recorded around events, and the same run recorded with every tick for comparison."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.recording.capture.selective import SelectiveSession
from tests.recording.real_loop import RecordedRun, eventful_configuration, read_rows, record, schedule

SECOND = 10_000
"""Ticks between two snapshots."""
TICKS = 20 * SECOND
BEFORE_S, AFTER_S = 1.2, 1.5
TRIP, STEP = 9_027, 113_456
"""Ticks of the trip, and of a change to a reference that saturates."""


def configuration_text() -> str:
    """Return the configuration of a run: the trip of `scheduled`, a reference that saturates for 0.4 s, a new mode."""
    return eventful_configuration() + schedule(
        (STEP, 'reference = { kind = "sine", amplitude = 27.0, frequency_hz = 3.0 }'),
        (STEP + 4_000, 'reference = { kind = "sine", amplitude = 5.0, frequency_hz = 3.0 }'),
        (17 * SECOND + 5, 'mode = "feedforward"'),
    )


def around_settings(*on: str, **changes: Any) -> dict[str, Any]:
    """Return the settings `around` of a header with the conditions `on`; `changes` replace or add settings."""
    return {"before_s": BEFORE_S, "after_s": AFTER_S, "every_s": 1.0, "on": list(on)} | changes


class SelectiveRun(RecordedRun):
    """The run of `configuration_text`, recorded around events; in virtual time unless it is paced."""

    session_class = SelectiveSession

    def __init__(self, path: Path, settings: dict[str, Any], *, paced: bool = False, **options: Any) -> None:
        super().__init__(path, configuration_text(), {"format": 2, "around": settings}, paced=paced, **options)


def recorded_rows(folder: Path) -> np.ndarray[Any, Any]:
    """Record every tick of the same run. Returns its rows (TICKS, columns)."""
    return read_rows(record(folder / "whole.mcap", configuration_text(), TICKS))


def retained_seconds(
    hits: np.ndarray[Any, Any], count: int, is_always_retained: Callable[[int], bool] = lambda k: k == 0
) -> list[int]:
    """Return the numbers (below `count`) of the seconds that a recording retains around the ticks `hits` (n,)."""
    low, high = hits - round(BEFORE_S * SECOND), hits + round(AFTER_S * SECOND)
    return [k for k in range(count) if is_always_retained(k) or np.any((k * SECOND <= high) & ((k + 1) * SECOND > low))]

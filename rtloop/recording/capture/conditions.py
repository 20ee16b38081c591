"""Around which events a recording is kept, in words: `trip`, `mode`, `command`, `late`, or a comparison of a signal.

    "x_error_um > 0.5"      "abs(x_drive_v) >= 9.5"      "driver_status != 0"

`trip`: the loop tripped, or its driver failed; `mode`: a change of mode took effect; `command`: any command did;
`late`: a tick missed at least one period. A comparison holds at every tick at which it is true; with NaN it is not.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple

import numpy as np

from rtloop.recording.file.topics.events import COMMANDS
from rtloop.signals import PERIODS_MISSED, TICK

COMPARISONS = {">=": operator.ge, "<=": operator.le, "==": operator.eq, "!=": operator.ne, ">": operator.gt,
               "<": operator.lt}  # fmt: skip
OF_EVENTS = {"trip": frozenset({"tripped", "driver_failed"}), "mode": frozenset({"set_mode"}), "command": COMMANDS}
LATE = "late"
WORDS = (*OF_EVENTS, LATE)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_COMPARISON = re.compile(rf"\s*(?:(abs)\(\s*(\w+)\s*\)|(\w+))\s*({'|'.join(COMPARISONS)})\s*({_NUMBER})\s*")


class Comparison(NamedTuple):
    """Of a signal, or of its absolute value, with a number."""

    signal: str
    absolute: bool
    sign: str
    level: float


class Hit(NamedTuple):
    """The first and the last tick at which a condition holds among those that were looked at."""

    first: int
    last: int
    condition: str


def comparison_of(text: str) -> Comparison | None:
    """What a condition compares; None for one of WORDS. Raises ValueError for anything else."""
    if text in WORDS:
        return None
    match = _COMPARISON.fullmatch(text)
    if match is None:
        names = ", ".join(WORDS)
        raise ValueError(f"no condition; {names}, or a comparison such as \"x_error_um > 0.5\" or "
                         '"abs(x_drive_v) >= 9.5" is allowed')  # fmt: skip
    absolute, absolute_signal, signal, sign, level = match.groups()
    return Comparison(absolute_signal or signal, bool(absolute), sign, float(level))


def unknown_signal(text: str, columns: Sequence[str]) -> str | None:
    """What is wrong with the signal of a condition where it is none of `columns`."""
    comparison = comparison_of(text)
    if comparison is None or comparison.signal in columns:
        return None
    suggestions = get_close_matches(comparison.signal, columns, n=1)
    hint = f"; did you mean {suggestions[0]}?" if suggestions else ""
    return f"{text!r}: no signal {comparison.signal!r}{hint}; there are {', '.join(columns)}"


class Conditions:
    """The conditions `texts`, over rows with these columns and kinds of events."""

    def __init__(self, texts: Sequence[str], columns: Sequence[str]) -> None:
        self._kinds = {text: OF_EVENTS[text] for text in texts if text in OF_EVENTS}
        self._late = LATE in texts
        comparisons = [(text, comparison) for text in texts if (comparison := comparison_of(text)) is not None]
        self._compared = [(text, columns.index(comparison.signal), comparison) for text, comparison in comparisons]

    def find(self, rows: np.ndarray[Any, Any], events: Sequence[tuple[int, str]]) -> list[Hit]:
        """Where they hold in rows (n, columns) and among events (tick, kind), by their first ticks."""
        hits = []
        for text, kinds in self._kinds.items():
            ticks = [tick for tick, kind in events if kind in kinds]
            hits += [Hit(min(ticks), max(ticks), text)] if ticks else []
        if self._late:
            hits += _hit(rows, rows[:, PERIODS_MISSED] > 0, LATE)
        for text, column, comparison in self._compared:
            values = np.abs(rows[:, column]) if comparison.absolute else rows[:, column]
            hits += _hit(rows, COMPARISONS[comparison.sign](values, comparison.level) & ~np.isnan(values), text)
        return sorted(hits)


def _hit(rows: np.ndarray[Any, Any], holds: np.ndarray[Any, Any], text: str) -> list[Hit]:
    indices = np.flatnonzero(holds)
    return [Hit(int(rows[indices[0], TICK]), int(rows[indices[-1], TICK]), text)] if indices.size else []

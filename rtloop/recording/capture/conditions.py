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
    found = _COMPARISON.fullmatch(text)
    if found is None:
        words = ", ".join(WORDS)
        raise ValueError(f"no condition; {words}, or a comparison such as \"x_error_um > 0.5\" or "
                         '"abs(x_drive_v) >= 9.5" is allowed')  # fmt: skip
    absolute, within, signal, sign, level = found.groups()
    return Comparison(within or signal, bool(absolute), sign, float(level))


def unknown_signal(text: str, columns: Sequence[str]) -> str | None:
    """What is wrong with the signal of a condition where it is none of `columns`."""
    compared = comparison_of(text)
    if compared is None or compared.signal in columns:
        return None
    near = get_close_matches(compared.signal, columns, n=1)
    meant = f"; did you mean {near[0]}?" if near else ""
    return f"{text!r}: no signal {compared.signal!r}{meant}; there are {', '.join(columns)}"


class Conditions:
    """The conditions `texts`, over rows with these columns and kinds of events."""

    def __init__(self, texts: Sequence[str], columns: Sequence[str]) -> None:
        self._kinds = {text: OF_EVENTS[text] for text in texts if text in OF_EVENTS}
        self._late = LATE in texts
        compared = [(text, one) for text in texts if (one := comparison_of(text)) is not None]
        self._compared = [(text, columns.index(one.signal), one) for text, one in compared]

    def find(self, rows: np.ndarray[Any, Any], events: Sequence[tuple[int, str]]) -> list[Hit]:
        """Where they hold in rows (n, columns) and among events (tick, kind), by their first ticks."""
        hits = []
        for text, kinds in self._kinds.items():
            ticks = [tick for tick, kind in events if kind in kinds]
            hits += [Hit(min(ticks), max(ticks), text)] if ticks else []
        if self._late:
            hits += _hit(rows, rows[:, PERIODS_MISSED] > 0, LATE)
        for text, column, one in self._compared:
            values = np.abs(rows[:, column]) if one.absolute else rows[:, column]
            hits += _hit(rows, COMPARISONS[one.sign](values, one.level) & ~np.isnan(values), text)
        return sorted(hits)


def _hit(rows: np.ndarray[Any, Any], holds: np.ndarray[Any, Any], text: str) -> list[Hit]:
    places = np.flatnonzero(holds)
    return [Hit(int(rows[places[0], TICK]), int(rows[places[-1], TICK]), text)] if places.size else []

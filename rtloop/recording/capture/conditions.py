"""Conditions that make a recording keep ticks: `trip`, `mode`, `command`, `late`, or a comparison of a signal.

    "x_error_um > 0.5"      "abs(x_drive_v) >= 9.5"      "driver_status != 0"

`trip`: the loop tripped, or its driver failed; `mode`: a change of mode took effect; `command`: a command of any kind
took effect; `late`: a tick missed at least one period. A comparison holds at every tick at which it is true; for NaN it
is false.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.recording.file.topics.events import COMMANDS
from rtloop.signals import PERIODS_MISSED, TICK

COMPARISONS = {">=": operator.ge, "<=": operator.le, "==": operator.eq, "!=": operator.ne, ">": operator.gt,
               "<": operator.lt}  # fmt: skip
EVENT_KINDS = {"trip": frozenset({"tripped", "driver_failed"}), "mode": frozenset({"set_mode"}), "command": COMMANDS}
LATE = "late"
CONDITION_NAMES = (*EVENT_KINDS, LATE)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_COMPARISON = re.compile(rf"\s*(?:(abs)\(\s*(\w+)\s*\)|(\w+))\s*({'|'.join(COMPARISONS)})\s*({_NUMBER})\s*")


class Comparison(NamedTuple):
    """Comparison of a signal, or of its absolute value if `absolute`, with the number `level`.

    `sign` is the operator, a key of COMPARISONS such as ">=".
    """

    signal: str
    absolute: bool
    sign: str
    level: float


class Hit(NamedTuple):
    """First and last of the examined ticks at which a condition holds."""

    first: int
    last: int
    condition: str


def parse_comparison(text: str) -> Comparison | None:
    """Return the comparison that `text` states; None for one of CONDITION_NAMES. Raises ValueError for other text."""
    if text in CONDITION_NAMES:
        return None
    match = _COMPARISON.fullmatch(text)
    if match is None:
        names = ", ".join(CONDITION_NAMES)
        raise ValueError(f"not a condition; allowed: {names}, or a comparison such as \"x_error_um > 0.5\" or "
                         '"abs(x_drive_v) >= 9.5"')  # fmt: skip
    absolute, absolute_signal, signal, sign, level = match.groups()
    return Comparison(absolute_signal or signal, bool(absolute), sign, float(level))


def signal_problem(text: str, columns: Sequence[str]) -> str | None:
    """Describe the fault if a condition compares a signal that is not in `columns`; None if there is no fault.

    Raises ValueError if `text` is no condition.
    """
    comparison = parse_comparison(text)
    if comparison is None or comparison.signal in columns:
        return None
    from difflib import get_close_matches

    suggestions = get_close_matches(comparison.signal, columns, n=1)
    hint = f"; did you mean {suggestions[0]}?" if suggestions else ""
    return f"{text!r}: no signal {comparison.signal!r}{hint}; allowed: {', '.join(columns)}"


class Conditions:
    """Conditions of a recording around events, to test on rows of ticks and on events."""

    def __init__(self, texts: Sequence[str], columns: Sequence[str]) -> None:
        """Parse the conditions `texts`, for rows with the signals `columns`.

        Raises ValueError for a text that is no condition, and for a signal that is not in `columns`.
        """
        self._kinds = {text: EVENT_KINDS[text] for text in texts if text in EVENT_KINDS}
        self._late = LATE in texts
        comparisons = [(text, comparison) for text in texts if (comparison := parse_comparison(text)) is not None]
        self._comparisons = [(text, columns.index(comparison.signal), comparison) for text, comparison in comparisons]

    def find_hits(self, rows: Real, events: Sequence[tuple[int, str]]) -> list[Hit]:
        """Return a hit for each condition that holds in rows (n, columns) or events (tick, kind), sorted by first tick.

        A hit spans all ticks from the first to the last at which the condition holds; between these two ticks the
        condition may be false.
        """
        hits = []
        for text, kinds in self._kinds.items():
            ticks = [tick for tick, kind in events if kind in kinds]
            hits += [Hit(min(ticks), max(ticks), text)] if ticks else []
        if self._late:
            hits += _signal_hits(rows, rows[:, PERIODS_MISSED] > 0, LATE)
        for text, column, comparison in self._comparisons:
            values = np.abs(rows[:, column]) if comparison.absolute else rows[:, column]
            hits += _signal_hits(rows, COMPARISONS[comparison.sign](values, comparison.level) & ~np.isnan(values), text)
        return sorted(hits)


def _signal_hits(rows: Real, mask: npt.NDArray[np.bool_], condition: str) -> list[Hit]:
    """Return [hit] of `condition`, from the first to the last row where `mask` (n,) is true; [] if none is true."""
    indices = np.flatnonzero(mask)
    return [Hit(int(rows[indices[0], TICK]), int(rows[indices[-1], TICK]), condition)] if indices.size else []

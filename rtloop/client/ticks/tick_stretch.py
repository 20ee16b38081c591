"""Consecutive ticks of one run of a loop, as a reader delivers them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.signals import COMMON_SIGNALS, DEADLINE

DEADLINE_NS = COMMON_SIGNALS[DEADLINE].name
BATCH_S = 0.25


@dataclass(frozen=True, slots=True)
class Stretch:
    """Records `rows` (n, columns) of n consecutive ticks from tick `first` on; `stretch["x_position_um"]` is one
    signal (n,).
    """

    columns: Sequence[str]
    first: int
    rows: Real
    lost: int = 0
    """Ticks before `first` that were overwritten before they could be read."""
    run: int = 0
    """Number of the run, from 0; a loop that starts again counts its ticks from 0."""

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, name: str) -> Real:
        """Return one signal (n,) as a view. Raises ValueError for a signal that the loop does not have."""
        return self.rows[:, column_index(name, self.columns)]

    @property
    def end(self) -> int:
        """Number of the tick after the last tick of the stretch."""
        return self.first + len(self.rows)

    def periods(self, rate_hz: float) -> Real:
        """Return the number of the period in which each tick was due, counted from 0 at the start of the run, for a
        loop at `rate_hz`: whole numbers as floats (n,). A missed period has no tick, so its number is skipped.
        """
        return np.rint(self[DEADLINE_NS] * (rate_hz / 1e9))


class Batch:
    """Collects short stretches of a run, so that they are processed together: the cost hardly depends on the length."""

    def __init__(self, rate_hz: float) -> None:
        """Begin without ticks, for a loop at this rate."""
        self._ticks = BATCH_S * rate_hz
        self._stretches: list[Stretch] = []

    def add(self, stretch: Stretch) -> Stretch | None:
        """Add a stretch of the same run. Once BATCH_S of ticks or more are collected, remove and return them as `take`
        does; else return None.

        The caller calls `take` before it adds a stretch of another run.
        """
        self._stretches.append(stretch)
        return self.take() if sum(map(len, self._stretches)) >= self._ticks else None

    def take(self) -> Stretch | None:
        """Remove and return all collected ticks as one stretch; None without ticks.

        If ticks were lost between the collected stretches, `lost` counts them, and `end` and the numbers of the later
        ticks are too low.
        """
        stretches, self._stretches = self._stretches, []
        if not stretches:
            return None
        return replace(
            stretches[0],
            rows=np.concatenate([stretch.rows for stretch in stretches]),
            lost=sum(stretch.lost for stretch in stretches),
        )


def column_index(name: str, columns: Sequence[str]) -> int:
    """Return the index of the signal `name` in `columns`. Raises ValueError for a name that is not among them."""
    try:
        return columns.index(name)
    except ValueError:
        raise ValueError(f"signal {name!r}: not recorded; allowed: {', '.join(columns)}") from None

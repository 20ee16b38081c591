"""Consecutive ticks of one run of a loop, as they were read."""

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
    """Whole records, `rows` (n, columns), of the ticks from `first` on; `stretch["x_position_um"]` is (n,)."""

    columns: Sequence[str]
    first: int
    rows: Real
    lost: int = 0
    """Ticks before `first` that were overwritten before they could be read."""
    run: int = 0
    """Goes up by one where the loop was started anew and counts its ticks from 0 again."""

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, name: str) -> Real:
        """A signal (n,), a view. Raises ValueError for one that the loop does not have."""
        return self.rows[:, column_index(name, self.columns)]

    @property
    def end(self) -> int:
        """The tick behind the last one."""
        return self.first + len(self.rows)

    def periods(self, rate_hz: float) -> Real:
        """Which period of the grid of deadlines each tick ran in (n,): one after the other but for holes."""
        return np.rint(self[DEADLINE_NS] * (rate_hz / 1e9))


class Batch:
    """Stretches of a run that are worked on together: most of what a short one costs, it costs at any length."""

    def __init__(self, rate_hz: float) -> None:
        self._ticks = BATCH_S * rate_hz
        self._stretches: list[Stretch] = []

    def add(self, stretch: Stretch) -> Stretch | None:
        """All that are kept, as soon as they last for BATCH_S."""
        self._stretches.append(stretch)
        return self.take() if sum(map(len, self._stretches)) >= self._ticks else None

    def take(self) -> Stretch | None:
        """All that are kept, one behind the other: between them ticks may be lost. None where there are none."""
        stretches, self._stretches = self._stretches, []
        if not stretches:
            return None
        return replace(
            stretches[0],
            rows=np.concatenate([stretch.rows for stretch in stretches]),
            lost=sum(stretch.lost for stretch in stretches),
        )


def column_index(name: str, columns: Sequence[str]) -> int:
    """Column of a signal. Raises ValueError for one that is not among `columns`."""
    try:
        return columns.index(name)
    except ValueError:
        raise ValueError(f"signal {name!r}: not in the record; {', '.join(columns)} are") from None

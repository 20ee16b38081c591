"""What was changed of a loop's axes while it runs, so that it can be taken back."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import NamedTuple

from rtloop.configuration.axis import AxisOptions

MOST = 100


class Change(NamedTuple):
    """Of axis `number`, as it was before, and what was changed."""

    number: int
    before: AxisOptions
    what: str


class Changes:
    """The last MOST."""

    def __init__(self) -> None:
        self._made: deque[Change] = deque(maxlen=MOST)

    def note(self, change: Change) -> None:
        """It was made."""
        self._made.append(change)

    def last(self, numbers: Collection[int]) -> Change | None:
        """The last one of any of these axes; None where there is none."""
        return next((change for change in reversed(self._made) if change.number in numbers), None)

    def forget(self, change: Change | None = None) -> None:
        """It was taken back; all of them cannot be any more, by default."""
        if change is None:
            self._made.clear()
        else:
            del self._made[next(i for i, candidate in enumerate(self._made) if candidate is change)]

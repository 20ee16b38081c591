"""History of the changes of a running loop's axes, for undo."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import NamedTuple

from rtloop.configuration.axis import AxisOptions

MAX_CHANGES = 100


class Change(NamedTuple):
    """A change: number of the axis, its options before, and the change in words."""

    number: int
    before: AxisOptions
    text: str


class ChangeHistory:
    """The last MAX_CHANGES changes."""

    def __init__(self) -> None:
        """Begin without changes of any axis."""
        self._changes: deque[Change] = deque(maxlen=MAX_CHANGES)

    def add(self, change: Change) -> None:
        """Add a change as the newest one; beyond MAX_CHANGES the oldest one is removed."""
        self._changes.append(change)

    def newest(self, axis_numbers: Collection[int]) -> Change | None:
        """Return the newest change of any of the axes `axis_numbers`, which stays in the history; None without one."""
        return next((change for change in reversed(self._changes) if change.number in axis_numbers), None)

    def remove(self, change: Change | None = None) -> None:
        """Remove `change`, which must be an object that the history holds; None removes all changes."""
        if change is None:
            self._changes.clear()
        else:
            del self._changes[next(i for i, candidate in enumerate(self._changes) if candidate is change)]

"""History of the changes of a running loop's axes, for undo."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from rtloop.configuration.axis import AxisOptions

MAX_CHANGES = 100


class Change(NamedTuple):
    """A change: number of the axis, its changed section, its options before, and the change in words."""

    number: int
    section: str
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

    def newest(self, number: int, owner: int) -> tuple[Change | None, Change | None]:
        """Return the newest change that `undo` of axis `number` may take back, and the change that blocks it; each None
        if there is none.

        Candidates are all changes of axis `number`, and changes of the section "controller" of axis `owner`, whose
        controller axis `number` uses. A newer change of another section of `owner` blocks a change of the controller,
        which restores all options of `owner`. Nothing is removed from the history.
        """
        blocker = None
        for change in reversed(self._changes):
            if change.number == number:
                return change, None
            if change.number == owner and change.section == "controller":
                return change, blocker
            if change.number == owner and blocker is None:
                blocker = change
        return None, None

    def remove(self, change: Change | None = None) -> None:
        """Remove `change`, which must be an object that the history holds; None removes all changes."""
        if change is None:
            self._changes.clear()
        else:
            del self._changes[next(i for i, candidate in enumerate(self._changes) if candidate is change)]

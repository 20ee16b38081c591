"""One more reader of a running service's ring of ticks, with a cursor of its own; whatever it does, no tick waits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.engine.messages import MESSAGE
from rtloop.engine.ring import Ring, drain
from rtloop.errors import UnavailableError
from rtloop.panel.mapping import BlockMapping, is_current, open_mapping
from rtloop.panel.stretch import Stretch

MAX_TICKS = 1 << 14
"""In one stretch, so that whoever reads a full ring can do something else in between."""
MAX_EVENTS = 1 << 12
CLEARANCE = 16
"""Of a full ring one part in so many, the oldest, is left to the writer, which is about to overwrite it."""


class Reader:
    """Reads the ring in the shared block at `path`, whenever there is one; a service that starts again has another.

    `columns` says which signals the loop records, and is asked once a run. The first stretch begins with what the ring
    still holds, about ten seconds ago.
    """

    def __init__(self, path: Path, read_columns: Callable[[], Sequence[str]]) -> None:
        self._path, self._read_columns = path, read_columns
        self._mapping: BlockMapping | None = None
        self._ring: Ring | None = None
        self._columns: tuple[str, ...] = ()
        self._events: Ring | None = None
        self._cursor = self._event_cursor = 0
        self.run = -1
        """Number of the run that is read, from 0 on."""
        self.lost_ticks = 0
        """Ticks that were overwritten before they could be read, in all runs."""

    def read(self) -> Stretch | None:
        """The next ticks; None where there are none now. Waits for nothing.

        Raises HostRefused, UnavailableError, and what `columns` raises.
        """
        stretch = self._read_mapped()
        if (
            stretch is None
            and (self._mapping is None or not is_current(self._mapping, self._path))
            and self._switch_block()
        ):
            stretch = self._read_mapped()
        return stretch

    def read_messages(self) -> np.ndarray[Any, np.dtype[np.void]]:
        """The next events of the run that is read, (n,) of MESSAGE; those of a tick are there before it is."""
        ready_count = 0 if self._events is None else int(self._events.head[0]) - self._event_cursor
        messages = np.zeros(min(ready_count, MAX_EVENTS), MESSAGE)
        if self._events is None or not ready_count:
            return messages
        copied_count, first, _ = drain(self._events, self._event_cursor, messages)
        self._event_cursor = first + copied_count
        return messages[:copied_count]

    def _switch_block(self) -> bool:
        """Go over to the block that lies there now; False while no loop has made one."""
        mapping = open_mapping(self._path)
        if mapping is None:
            return False
        ring, columns = mapping.tick_ring(), tuple(self._read_columns())
        capacity, width = ring.slots.shape
        if len(columns) != width:
            raise UnavailableError(f"{self._path}: records of {width} signals, and {len(columns)} names for them")
        if self._mapping is None:
            self._cursor = max(int(ring.head[0]) - capacity + capacity // CLEARANCE, 0)
        else:
            self._cursor = 0
        self._mapping, self._ring, self._columns = mapping, ring, columns
        self._events, self._event_cursor = mapping.event_ring(), 0
        self.run += 1
        return True

    def _read_mapped(self) -> Stretch | None:
        if self._ring is None:
            return None
        ready_count = int(self._ring.head[0]) - self._cursor
        if ready_count == 0:
            return None
        rows = np.empty((min(ready_count, MAX_TICKS), len(self._columns)))
        copied_count, first, lost = drain(self._ring, self._cursor, rows)
        if copied_count == 0:
            return None
        self._cursor = first + copied_count
        self.lost_ticks += lost
        return Stretch(self._columns, first, rows[:copied_count], lost, self.run)

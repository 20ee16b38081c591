"""Reader of a running service's ring of ticks. It has a separate cursor and never delays a tick."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtloop.client.ticks.block_mapping import BlockMapping, is_current, open_mapping
from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.engine.messages import MESSAGE
from rtloop.engine.ring import Ring, drain
from rtloop.errors import UnavailableError
from rtloop.supervision.recording_state import RecordingState, recording_state

MAX_TICKS = 1 << 14
"""Largest stretch, so that the caller can do other work while it reads a full ring."""
MAX_EVENTS = 1 << 12
CLEARANCE = 16
"""The reader skips the oldest 1/CLEARANCE of a full ring, which the loop overwrites next."""


class Reader:
    """Reads the ring in the shared block at `path`, also if the block appears later or a new service replaces it.

    `read_columns` returns the signals that the loop records; it is called once for each run. The first stretch begins
    with the oldest ticks in the ring, about ten seconds old.
    """

    def __init__(self, path: Path, read_columns: Callable[[], Sequence[str]]) -> None:
        """Map no block yet; `read` maps the block at `path`."""
        self._path, self._read_columns = path, read_columns
        self._mapping: BlockMapping | None = None
        self._ring: Ring | None = None
        self._columns: tuple[str, ...] = ()
        self._events: Ring | None = None
        self._cursor = self._event_cursor = 0
        self.run = -1
        """Number of the run that is read, from 0; −1 before the first."""
        self.lost_ticks = 0
        """Ticks that were overwritten before they could be read, in all runs."""

    def read(self) -> Stretch | None:
        """Return a copy of the next ticks, at most MAX_TICKS, without waiting; None if there are none.

        Ticks that were overwritten before they could be read are skipped, and counted in the stretch's `lost` and in
        `lost_ticks`. Once the mapped block has no more ticks and another block lies at the path, a new run begins.
        Raises HostRefusal for a block that another user may have written, UnavailableError for one that cannot be
        opened or has another number of signals than `read_columns` returns, and the errors of `read_columns`.
        """
        stretch = self._read_mapped()
        if stretch is not None or (self._mapping is not None and is_current(self._mapping, self._path)):
            return stretch
        return self._read_mapped() if self._switch_block() else None

    def read_messages(self) -> npt.NDArray[np.void]:
        """Return the run's next events, (n,) of MESSAGE, oldest first, 0 ≤ n ≤ MAX_EVENTS, without waiting.

        Empty before `read` has mapped a block. An event may come before `read` returns its tick. Events that were
        overwritten before they could be read are skipped.
        """
        ready_count = 0 if self._events is None else int(self._events.head[0]) - self._event_cursor
        messages = np.zeros(min(ready_count, MAX_EVENTS), MESSAGE)
        if self._events is None or not ready_count:
            return messages
        copied_count, first, _ = drain(self._events, self._event_cursor, messages)
        self._event_cursor = first + copied_count
        return messages[:copied_count]

    @property
    def recording_state(self) -> RecordingState | None:
        """State of the run's recording; None before `read` has mapped a block."""
        return None if self._mapping is None else recording_state(self._mapping)

    def _switch_block(self) -> bool:
        """Map the block that lies at the path now, begin a run and return True; without a block, return False and
        keep the present run.

        The first run begins with the oldest ticks in the ring that the loop does not overwrite at once, a later run
        with tick 0. Raises as `read`.
        """
        mapping = open_mapping(self._path)
        if mapping is None:
            return False
        ring, columns = mapping.tick_ring(), tuple(self._read_columns())
        capacity, width = ring.slots.shape
        if len(columns) != width:
            raise UnavailableError(
                f"{self._path}: ticks have {width} signals, but the service names {len(columns)} signals; if the "
                "service was just started again, try again; else use the same version of rtloop as the service"
            )
        if self._mapping is None:
            self._cursor = max(int(ring.head[0]) - capacity + capacity // CLEARANCE, 0)
        else:
            self._cursor = 0
        self._mapping, self._ring, self._columns = mapping, ring, columns
        self._events, self._event_cursor = mapping.event_ring(), 0
        self.run += 1
        return True

    def _read_mapped(self) -> Stretch | None:
        """Return a copy of the next ticks of the mapped block, at most MAX_TICKS, and add lost ones to `lost_ticks`.

        None if there are none, or no block is mapped.
        """
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

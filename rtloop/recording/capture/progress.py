"""The recorder's progress in words of the shared block: a replacement recorder continues there if this one dies.

A recorder may die between a write and the update of its progress, or in the middle of either. It therefore announces
each write: the byte of the file at which the write begins, and the ring position after it. The file itself shows
whether the write was done: a chunk is in the file as a whole or not at all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from rtloop.engine.memory import SharedBlock, Word
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.topics.contents import accounts_for_ticks, chunk_contents_from, starts_with_tick


class RingPosition(NamedTuple):
    """Numbers of ticks, snapshots and events of the rings that are written or lost; `lost` of the ticks are in no file.

    Each number is also the number of the next slot to read from its ring.
    """

    ticks: int
    snapshots: int
    events: int
    lost: int

    def furthest(self, position: RingPosition) -> RingPosition:
        """Return the larger number of this and the other `position` for each ring; `lost` is that of this position."""
        return self._make([*map(max, self[:3], position[:3]), self.lost])


FLUSHED = (Word.FLUSHED_TICKS, Word.FLUSHED_SNAPSHOTS, Word.FLUSHED_EVENTS, Word.LOST_TICKS)
ANNOUNCED = (Word.ANNOUNCED_TICKS, Word.ANNOUNCED_SNAPSHOTS, Word.ANNOUNCED_EVENTS, Word.ANNOUNCED_LOST)


class RecorderProgress:
    """Written and announced position of the recorder of `block`; they differ only while a write is in progress."""

    def __init__(self, block: SharedBlock) -> None:
        """Keep `block`, whose words hold the progress; no word is read or stored yet."""
        self._block = block

    @property
    def flushed_position(self) -> RingPosition:
        """Ring position before which all data is in files or lost, read from the shared block."""
        return self._load(FLUSHED)

    def store_flushed(self, position: RingPosition) -> None:
        """Store in the block that all data before `position` is in files or lost, and that no write is announced."""
        self._store(FLUSHED, position)
        self._store(ANNOUNCED, position)

    @contextmanager
    def announced_write(self, begin_byte: int, end_position: RingPosition) -> Iterator[None]:
        """Announce, in the shared block, the write that the `with` statement runs, and store it as done afterwards.

        The write begins at byte `begin_byte` of the file; `end_position` is the ring position after it. An error
        withdraws the announcement and is raised; a write that raises must leave the file unchanged.
        """
        previous = self.flushed_position
        # The byte comes first: the file holds nothing behind it yet, whatever position is announced.
        self._block.store(Word.ANNOUNCED_BYTE, begin_byte)
        self._store(ANNOUNCED, end_position)
        try:
            yield
        except BaseException:
            self._store(ANNOUNCED, previous)
            raise
        self._store(FLUSHED, end_position)

    def predecessor_position(self, part: Path | None) -> RingPosition:
        """Ring position that the dead recorder reached, by the shared block and its unfinished file `part`, if any.

        An announced write counts, even if not stored as done: its ticks if their chunk is in `part`, its snapshots and
        events if a chunk with messages is.
        """
        position, announced = self.flushed_position, self._load(ANNOUNCED)
        for content in _chunk_contents_from(part, self._block.load(Word.ANNOUNCED_BYTE)) if part else []:
            if accounts_for_ticks(content):
                position = position._replace(ticks=announced.ticks, lost=announced.lost)
            if not starts_with_tick(content):
                position = position._replace(snapshots=announced.snapshots, events=announced.events)
        return position

    def _load(self, words: Sequence[Word]) -> RingPosition:
        """Load a position from four words of the block: ticks, snapshots, events, lost ticks."""
        return RingPosition(*map(self._block.load, words))

    def _store(self, words: Sequence[Word], position: RingPosition) -> None:
        """Store a position in four words of the block: ticks, snapshots, events, lost ticks."""
        for word, value in zip(words, position, strict=True):
            self._block.store(word, value)


def _chunk_contents_from(part: Path, byte: int) -> list[bytes]:
    """Return the contents of the undamaged chunks from `byte` of a file on; [] for a missing or unreadable file."""
    try:
        return list(chunk_contents_from(part, byte))
    except RecordingError:
        return []

"""How far the rings are written, in words of the shared block: where another recorder goes on if this one dies.

It may die between a write and its note of it, or in the middle of either. A write is therefore announced before: where
in the file it begins, and what it will reach. Whether it came about is seen in the file itself, whose chunks are there
as a whole or not at all.
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
    """Up to which ticks, snapshots and events of the rings are in files; how many ticks before it are in none."""

    ticks: int
    snapshots: int
    events: int
    lost: int

    def furthest(self, position: RingPosition) -> RingPosition:
        """This position, or `other` for the rings in which that one is further; `lost` stays."""
        return RingPosition(
            max(self.ticks, position.ticks),
            max(self.snapshots, position.snapshots),
            max(self.events, position.events),
            self.lost,
        )


FLUSHED = (Word.FLUSHED_TICKS, Word.FLUSHED_SNAPSHOTS, Word.FLUSHED_EVENTS, Word.LOST_TICKS)
ANNOUNCED = (Word.ANNOUNCED_TICKS, Word.ANNOUNCED_SNAPSHOTS, Word.ANNOUNCED_EVENTS, Word.ANNOUNCED_LOST)


class RecorderProgress:
    """Of the recorder of `block`. What is announced is what is written, but while a write is under way."""

    def __init__(self, block: SharedBlock) -> None:
        self._block = block

    @property
    def written_position(self) -> RingPosition:
        """As it was noted last."""
        return self._load(FLUSHED)

    def store_written(self, position: RingPosition) -> None:
        """All before `position` is in files, or lost."""
        self._store(FLUSHED, position)
        self._store(ANNOUNCED, position)

    @contextmanager
    def announced_write(self, begin_byte: int, end_position: RingPosition) -> Iterator[None]:
        """A write that begins at `byte` of the file and gets to `reached`, or raises and leaves the file as it was."""
        previous = self.written_position
        self._block.store(
            Word.ANNOUNCED_BYTE, begin_byte
        )  # first: behind it there is nothing yet, whatever is announced
        self._store(ANNOUNCED, end_position)
        try:
            yield
        except BaseException:
            self._store(ANNOUNCED, previous)
            raise
        self._store(FLUSHED, end_position)

    def predecessor_position(self, part: Path | None) -> RingPosition:
        """Where the recorder before this one came to, whose unfinished file is `part`."""
        position, announced = self.written_position, self._load(ANNOUNCED)
        for content in _chunk_contents_from(part, self._block.load(Word.ANNOUNCED_BYTE)) if part else []:
            if accounts_for_ticks(content):
                position = position._replace(ticks=announced.ticks, lost=announced.lost)
            if not starts_with_tick(content):
                position = position._replace(snapshots=announced.snapshots, events=announced.events)
        return position

    def _load(self, words: Sequence[Word]) -> RingPosition:
        return RingPosition(*map(self._block.load, words))

    def _store(self, words: Sequence[Word], position: RingPosition) -> None:
        for word, value in zip(words, position, strict=True):
            self._block.store(word, value)


def _chunk_contents_from(part: Path, byte: int) -> list[bytes]:
    """The chunks of a file from `byte` on; none where it is not there, or finished."""
    try:
        return list(chunk_contents_from(part, byte))
    except RecordingError:
        return []

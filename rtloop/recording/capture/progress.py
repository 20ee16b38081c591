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
from rtloop.recording.file.topics.contents import contents_behind, is_ticks, tells_of_ticks


class Position(NamedTuple):
    """Up to which ticks, snapshots and events of the rings are in files; how many ticks before it are in none."""

    ticks: int
    snapshots: int
    events: int
    lost: int

    def at_least(self, other: Position) -> Position:
        """This position, or `other` for the rings in which that one is further; `lost` stays."""
        return Position(
            max(self.ticks, other.ticks),
            max(self.snapshots, other.snapshots),
            max(self.events, other.events),
            self.lost,
        )


FLUSHED = (Word.FLUSHED_TICKS, Word.FLUSHED_SNAPSHOTS, Word.FLUSHED_EVENTS, Word.LOST_TICKS)
ANNOUNCED = (Word.ANNOUNCED_TICKS, Word.ANNOUNCED_SNAPSHOTS, Word.ANNOUNCED_EVENTS, Word.ANNOUNCED_LOST)


class Progress:
    """Of the recorder of `block`. What is announced is what is written, but while a write is under way."""

    def __init__(self, block: SharedBlock) -> None:
        self._block = block

    @property
    def written(self) -> Position:
        """As it was noted last."""
        return self._load(FLUSHED)

    def note(self, position: Position) -> None:
        """All before `position` is in files, or lost."""
        self._store(FLUSHED, position)
        self._store(ANNOUNCED, position)

    @contextmanager
    def writing(self, byte: int, reached: Position) -> Iterator[None]:
        """A write that begins at `byte` of the file and gets to `reached`, or raises and leaves the file as it was."""
        previous = self.written
        self._block.store(Word.ANNOUNCED_BYTE, byte)  # first: behind it there is nothing yet, whatever is announced
        self._store(ANNOUNCED, reached)
        try:
            yield
        except BaseException:
            self._store(ANNOUNCED, previous)
            raise
        self._store(FLUSHED, reached)

    def found(self, part: Path | None) -> Position:
        """Where the recorder before this one came to, whose unfinished file is `part`."""
        position, announced = self.written, self._load(ANNOUNCED)
        for content in _contents_behind(part, self._block.load(Word.ANNOUNCED_BYTE)) if part else []:
            if tells_of_ticks(content):
                position = position._replace(ticks=announced.ticks, lost=announced.lost)
            if not is_ticks(content):
                position = position._replace(snapshots=announced.snapshots, events=announced.events)
        return position

    def _load(self, words: Sequence[Word]) -> Position:
        return Position(*map(self._block.load, words))

    def _store(self, words: Sequence[Word], position: Position) -> None:
        for word, value in zip(words, position, strict=True):
            self._block.store(word, value)


def _contents_behind(part: Path, byte: int) -> list[bytes]:
    """The chunks of a file from `byte` on; none where it is not there, or finished."""
    try:
        return list(contents_behind(part, byte))
    except RecordingError:
        return []

"""The files of one run, written one after the other, and the account of the ticks in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.errors import OutputError
from rtloop.recording.capture.buffer import TickTime
from rtloop.recording.file.mcap.chunkfile import NotOnDisk
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.overview import Intervals
from rtloop.recording.file.writer import Writer


class Options(NamedTuple):
    """Choices of a run. A rotated recording is NAME-0001.mcap, NAME-0002.mcap, …, each cut at a state snapshot."""

    rotate_bytes: int | None = None
    rotate_s: float | None = None
    min_free_bytes: int = 64 << 20
    message_index: bool = False
    sequence: int = 1
    """Number of the first file: above 1 where another recorder of the same run died."""


def numbered_path(path: Path, sequence: int) -> Path:
    """The name of one of several files of a run."""
    return path.with_name(f"{path.stem}-{sequence:04d}{path.suffix}")


def predecessor_file(path: Path, sequence: int) -> Path | None:
    """The unfinished file of the recorder that died before file number `sequence` was begun."""
    paths = [numbered_path(path, sequence - 1), *([path] if sequence == 2 else [])]
    parts = [name.with_name(f"{name.name}.part") for name in paths]
    return next((part for part in parts if part.exists()), None)


class RunFiles:
    """`begin` is where the first file begins, `logged` the ticks before it that earlier recorders left in files.

    `next` is the tick behind the last one in a file, `first` the first one that the present file accounts for. What
    is before `repeats_before` stands in an earlier recorder's file as well; None where nothing is repeated.
    """

    def __init__(
        self,
        path: Path,
        header: dict[str, Any],
        options: Options,
        begin: TickTime,
        ticks_logged: int,
        repeats_before: TickTime | None,
    ) -> None:
        self._path, self._header, self._options = path, header, options
        self._repeats_before = repeats_before
        self._opened_paths: list[Path] = []
        self._closed_ticks, self.closed_bytes, self._closed_skipped = ticks_logged, 0, 0
        self.end_place = self.file_begin = begin
        self.writer: Writer | None = None

    @property
    def paths(self) -> list[Path]:
        """The finished files that are there."""
        return [path for path in self._opened_paths if path.exists()]

    @property
    def ticks_logged(self) -> int:
        """Ticks in files."""
        return self._closed_ticks + (self.writer.ticks if self.writer else 0)

    @property
    def ticks_skipped(self) -> int:
        """Ticks that were left out, of which there are overviews."""
        return self._closed_skipped + (self.writer.ticks_skipped if self.writer else 0)

    @property
    def size_bytes(self) -> int:
        """Of the present file."""
        return self.writer.size_bytes if self.writer else 0

    def open_next(self, log_time: int, room_bytes: int = 0) -> Writer:
        """The next file, for `begin`; it accounts for the ticks from `next` on. Raises OutputError.

        `room_bytes`: to be free beside what is to stay free, and what the end of the present file takes.
        """
        path, header, options = self._path, self._header, self._options
        sequence = len(self._opened_paths) + options.sequence
        if options.rotate_bytes or options.rotate_s or sequence > 1:
            path = numbered_path(path, sequence)
            header = {**header, "sequence": sequence, "first_tick": self.end_place.tick}
        if self._repeats_before is not None and self.end_place.tick <= self._repeats_before.tick:
            header["repeats_before"] = self._repeats_before.tick
        index, min_free_bytes = options.message_index, options.min_free_bytes
        room_bytes += self.writer.end_bytes if room_bytes and self.writer else 0
        writer = Writer(
            path, header, log_time, message_index=index, min_free_bytes=min_free_bytes, room_bytes=room_bytes
        )
        self._opened_paths.append(path)
        return writer

    def switch_to(self, writer: Writer) -> None:
        """Go on in another file."""
        self.writer, self.file_begin = writer, self.end_place

    def write(self, messages: Sequence[Message], rows: np.ndarray[Any, Any], start_unix_ns: int, end: TickTime) -> None:
        """Messages and ticks, both or neither; the next file or tick is to go on at `end`. Raises OutputError."""
        assert self.writer is not None
        self.writer.start_unix_ns = start_unix_ns
        self.writer.write(messages, rows)
        self.end_place = end

    def write_overview(
        self, messages: Sequence[Message], intervals: Intervals, start_unix_ns: int, end: TickTime
    ) -> None:
        """As `write`, with intervals (n, columns, 3) instead of the ticks that they are about. Raises OutputError."""
        assert self.writer is not None
        self.writer.start_unix_ns = start_unix_ns
        self.writer.write_overview(messages, intervals)
        self.end_place = end

    def finish(self, final_message: Callable[[int], Message]) -> OutputError | None:
        """End the file with `final(ticks in it)`; what prevented it. Ticks that it lost after all come `next` again.

        Ticks of a file that may not be on the disk count as lost.
        """
        writer, self.writer = self.writer, None
        if writer is None:
            return None
        expected_ticks, problem = writer.ticks + writer.ticks_skipped, None
        try:
            writer.finish(final_message)
        except NotOnDisk as error:
            return error
        except OutputError as error:
            problem = error
            if not writer.is_in_place():
                self._abandon(writer)
                return problem
            writer.close()
        self.end_place = TickTime(
            self.end_place.tick - expected_ticks + writer.ticks + writer.ticks_skipped, self.end_place.time_ns
        )
        self._closed_ticks += writer.ticks
        self._closed_skipped += writer.ticks_skipped
        self.closed_bytes += writer.size_bytes
        return problem

    def discard_unusable(self) -> None:
        """Give up a file that was removed, and with it its ticks; remove one without ticks.

        Ticks that were still to be repeated are left out: an earlier file holds them.
        """
        if self.writer and not self.writer.is_in_place():
            self._abandon(self.writer)
        elif self.writer and not self.writer.ticks:
            self.writer.discard()
            self.writer = None
            self._opened_paths.pop()
        if self._repeats_before is not None and (count := self._repeats_before.tick - self.end_place.tick) > 0:
            self._closed_ticks += count
            self.end_place = self._repeats_before

    def _abandon(self, writer: Writer) -> None:
        writer.close()
        self.writer, self.end_place = None, self.file_begin

"""Files of one run, written one after the other, and the counts of the ticks in them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rtloop.errors import OutputError
from rtloop.foundation.arrays import Real
from rtloop.recording.capture.buffer import TickTime
from rtloop.recording.file.mcap.chunkfile import NotOnDisk
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.format import Header
from rtloop.recording.file.topics.overview import Intervals
from rtloop.recording.file.writer import Writer


class Options(NamedTuple):
    """Options of a run. A rotated recording is NAME-0001.mcap, NAME-0002.mcap, …; each begins at a snapshot.

    The next file begins once the present one has `rotate_bytes` or lasts `rotate_s` (None: no such limit). At least
    `min_free_bytes` of the disk stay free. `message_index` adds an index entry for every tick to the file.
    """

    rotate_bytes: int | None = None
    rotate_s: float | None = None
    min_free_bytes: int = 64 << 20
    message_index: bool = False
    sequence: int = 1
    """Number of the first file; above 1 for a recorder that replaces a dead one of the same run."""


def numbered_path(path: Path, sequence: int) -> Path:
    """Path of file number `sequence` of a run: NAME-0001.mcap for NAME.mcap and 1."""
    return path.with_name(f"{path.stem}-{sequence:04d}{path.suffix}")


def predecessor_file(path: Path, sequence: int) -> Path | None:
    """Path of the unfinished file (.part) with number `sequence` − 1, of a dead recorder; None if there is none.

    File number 1 may also have the name `path` without a number.
    """
    paths = [numbered_path(path, sequence - 1), *([path] if sequence == 2 else [])]
    parts = [name.with_name(f"{name.name}.part") for name in paths]
    return next((part for part in parts if part.exists()), None)


class RunFiles:
    """Present and finished files of a run; `end_place` is tick and deadline after the last tick in a file.

    The present file accounts for the ticks from `file_begin` on. `closed_bytes` is the size of the earlier files.
    """

    def __init__(
        self,
        path: Path,
        header: Header,
        options: Options,
        begin: TickTime,
        ticks_logged: int,
        repeats_before: TickTime | None,
    ) -> None:
        """Prepare the files of the run recorded as `path`, from `begin` on; no file is opened yet.

        `header` is the header of the run. `ticks_logged` counts the ticks before `begin` in files of earlier recorders.
        An earlier recorder's file also holds the ticks from `begin` to before `repeats_before`; None if it holds none.
        """
        self._path, self._header, self._options = path, header, options
        self._repeats_before = repeats_before
        self._opened_paths: list[Path] = []
        self._closed_ticks, self.closed_bytes, self._closed_skipped = ticks_logged, 0, 0
        self.end_place = self.file_begin = begin
        self.writer: Writer | None = None

    @property
    def paths(self) -> list[Path]:
        """Paths of the finished files of this recorder that still exist, oldest first."""
        return [path for path in self._opened_paths if path.exists()]

    @property
    def ticks_logged(self) -> int:
        """Number of ticks in the files of the run, the present file and the files of earlier recorders included."""
        return self._closed_ticks + (self.writer.ticks if self.writer else 0)

    @property
    def ticks_skipped(self) -> int:
        """Number of ticks that overviews replace in the files of this recorder."""
        return self._closed_skipped + (self.writer.ticks_skipped if self.writer else 0)

    @property
    def size_bytes(self) -> int:
        """Size of the present file in bytes; 0 without one."""
        return self.writer.file.size if self.writer else 0

    def open_next(self, log_time: int, room_bytes: int = 0) -> Writer:
        """Open the next file, for the ticks from `end_place` on; `switch` makes it the present one.

        `log_time` (UNIX ns) is the log time of its header. If `room_bytes` is not 0, so many bytes must be free beyond
        `min_free_bytes` and the index of the present file. Raises OutputError if the file cannot be created or the
        space is not free.
        """
        path, header, options = self._path, self._header, self._options
        sequence = len(self._opened_paths) + options.sequence
        if options.rotate_bytes or options.rotate_s or sequence > 1:
            path = numbered_path(path, sequence)
            header = {**header, "sequence": sequence, "first_tick": self.end_place.tick}
        if self._repeats_before is not None and self.end_place.tick <= self._repeats_before.tick:
            header["repeats_before"] = self._repeats_before.tick
        index, min_free_bytes = options.message_index, options.min_free_bytes
        room_bytes += self.writer.file.end_bytes if room_bytes and self.writer else 0
        writer = Writer(
            path, header, log_time, message_index=index, min_free_bytes=min_free_bytes, room_bytes=room_bytes
        )
        self._opened_paths.append(path)
        return writer

    def switch(self, writer: Writer) -> None:
        """Make `writer` the present file, for the ticks from `end_place` on; the former file must be finished."""
        self.writer, self.file_begin = writer, self.end_place

    @contextlib.contextmanager
    def packing(self, rows: Real, start_unix_ns: int) -> Iterator[None]:
        """Pack rows (n, columns) of ticks on all processors, while the block writes them by `write`, chunk by chunk.

        `start_unix_ns` as in `write`. Without a present file, the block runs without packing.
        """
        if self.writer is None:
            yield
            return
        self.writer.start_unix_ns = start_unix_ns
        with self.writer.packing(rows):
            yield

    def write(
        self, messages: Sequence[Message], rows: Real, intervals: Intervals | None, start_unix_ns: int, end: TickTime
    ) -> None:
        """Write messages and rows (n, columns): both, or neither.

        Then set `end_place` to `end`. Intervals (n, columns, 3: minimum, maximum, mean) are written instead of rows if
        they are not None. Raises OutputError if no file is open or the write fails.
        """
        if self.writer is None:
            raise OutputError(
                f"{self._path}: ticks are lost, because no file of the run is open; recording continues in another "
                "file as soon as one can be opened"
            )
        self.writer.start_unix_ns = start_unix_ns
        if intervals is None:
            self.writer.write(messages, rows)
        else:
            self.writer.write_overview(messages, intervals)
        self.end_place = end

    def finish(self, final_message: Callable[[int], Message]) -> OutputError | None:
        """Finish the present file with `final_message(ticks in it)`. Returns the error that prevented it, or None.

        `end_place` moves back by the ticks that were dropped to make room for the index, or to the first tick of a file
        that was removed. All ticks of a file that may not be on the disk count as lost. Without a present file nothing
        happens.
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
            if not writer.file.is_in_place():
                self._abandon(writer)
                return problem
            writer.close()
        self.end_place = TickTime(
            self.end_place.tick - expected_ticks + writer.ticks + writer.ticks_skipped, self.end_place.time_ns
        )
        self._closed_ticks += writer.ticks
        self._closed_skipped += writer.ticks_skipped
        self.closed_bytes += writer.file.size
        return problem

    def discard_unusable(self) -> None:
        """Give up a present file that was removed: its ticks are lost. Remove a present file that has only a header.

        Ticks before `repeats_before` that are not written yet are left out: the dead recorder's file holds them. They
        count in `ticks_logged`, and `end_place` moves behind them.
        """
        if self.writer and not self.writer.file.is_in_place():
            self._abandon(self.writer)
        elif self.writer and len(self.writer.file) <= 1:
            self.writer.discard()
            self.writer = None
            self._opened_paths.pop()
        if self._repeats_before is not None and (count := self._repeats_before.tick - self.end_place.tick) > 0:
            self._closed_ticks += count
            self.end_place = self._repeats_before

    def _abandon(self, writer: Writer) -> None:
        """Close the present file, which `writer` writes and whose ticks are lost; no file is present afterwards.

        `end_place` moves back to the first tick of that file.
        """
        writer.close()
        self.writer, self.end_place = None, self.file_begin

"""The disk quota of a configuration's recordings: the oldest files are removed first, never one around a trip.

Removed are finished files of runs of this configuration, identified by name and header. Files that stay: the newest
one, files with ticks around a trip, captures, files of other users, and unreadable files. Files are also removed if the
disk fills before the quota is reached: the current run needs the room.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from rtloop.errors import RtloopError
from rtloop.foundation import timing
from rtloop.foundation.trusted import is_own, open_own
from rtloop.recording.file.event_window import EventWindow
from rtloop.recording.file.reader import Reader
from rtloop.values import count_text

DERIVED_FILE_KEYS = ("cut", "imported")
"""Header keys of files that were cut or imported, which are no files of a run."""
SPARE_BYTES = 64 << 20
"""Added to the free space that is required, so that files are removed before the recorder has no room."""
BUDGET_S = 0.2
"""Time for reading new files in one call; unread files are not removed."""
BEFORE_S, AFTER_S = 10.0, 30.0
"""Time around a trip that is protected, for recordings of every tick, whose header has no event window."""


class FileContents(NamedTuple):
    """Contents of a finished file: run (name, start in ns since 1970), ticks `first` to `end` - 1.

    `trips` has the range of ticks (first, last) to keep around each trip.
    """

    run: tuple[str, int]
    first: int
    end: int
    trips: tuple[tuple[int, int], ...]


class FileEntry(NamedTuple):
    """A recording's file in the folder. Entries sort by start time of the run, then by number within it."""

    start_time: str
    number: int
    name: str
    bytes: int
    modified_ns: int


class Removal(NamedTuple):
    """A file that the quota removed."""

    file: Path
    size_bytes: int
    reason: str

    def __str__(self) -> str:
        """Return a sentence with the file and the reason of its removal."""
        return f"{self.file} was removed: {self.reason}"

    @property
    def event_details(self) -> dict[str, str | int]:
        """Details of the event that records the removal: {file: name, size_bytes, reason}."""
        return {"file": self.file.name, "size_bytes": self.size_bytes, "reason": self.reason}


class Quota:
    """Quota of the recordings of the configuration `name` in `folder`: at most `keep_bytes`, and at least
    `min_free_bytes` free on the disk.
    """

    def __init__(self, folder: Path, name: str, keep_bytes: int, min_free_bytes: int) -> None:
        """Set the limits, in bytes; nothing is removed before `enforce`. SPARE_BYTES are added to `min_free_bytes`."""
        self._folder, self._name = folder, name
        self._keep_bytes, self._free_bytes = keep_bytes, min_free_bytes + SPARE_BYTES
        self._pattern = re.compile(
            rf"{re.escape(name)}-(\d{{8}}T\d{{6}}(?:-\d{{1,3}})?)(?:-(\d{{4}}))?\.mcap(?:\.part)?"
        )
        self._contents: dict[FileEntry, FileContents] = {}
        self._unusable: set[FileEntry] = set()
        self.total_bytes = self.removed_files = self.removed_bytes = 0
        """Size of all recordings; number and size of the removed files."""
        self.failure: str | None = None
        """Why the last `enforce` was incomplete; None if it was complete."""

    def enforce(self, budget_s: float = BUDGET_S) -> list[Removal]:
        """Remove files, oldest first, until the quota holds or no more may be removed. Returns the removed files.

        `budget_s` limits the time for reading new files; unread ones stay. An OSError ends the work; it is reported in
        `failure`, as are files of other users. Also updates `total_bytes`, `removed_files` and `removed_bytes`.
        """
        removals: list[Removal] = []
        self.failure = None
        try:
            entries = self._list_entries()
            self._read_new_files(entries, budget_s)
            self.total_bytes = sum(entry.bytes for entry in entries)
            for entry in self._removable(entries):
                reason = self._removal_reason()
                if reason is None:
                    break
                (self._folder / entry.name).unlink()
                self.total_bytes -= entry.bytes
                self.removed_files, self.removed_bytes = self.removed_files + 1, self.removed_bytes + entry.bytes
                removals.append(Removal(self._folder / entry.name, entry.bytes, reason))
        except OSError as error:
            self.failure = f"{self._folder}: {error.strerror}"
        return removals

    def _removal_reason(self) -> str | None:
        """Return the exceeded limit in words; None if size and free space hold. Raises OSError of the file system."""
        if self.total_bytes > self._keep_bytes:
            return f"recordings of {self._name} may take at most {self._keep_bytes / 2**30:g} GiB (recording.keep_gib)"
        status = os.statvfs(self._folder)
        if status.f_bavail * status.f_frsize < self._free_bytes:
            return (
                f"less than {self._free_bytes >> 20} MiB are free on the disk "
                f"(recording.min_free_mib + {SPARE_BYTES >> 20} MiB)"
            )
        return None

    def _removable(self, entries: list[FileEntry]) -> list[FileEntry]:
        """Return the entries that may be removed, oldest first: finished, read, not the newest, not around a trip.

        Files of a run of which a finished file is unread stay: it may contain a trip.
        """
        finished_entries = [entry for entry in entries if entry.name.endswith(".mcap")]
        unread_runs = {entry.start_time for entry in finished_entries if entry not in self._contents}
        return [
            entry
            for entry in finished_entries[:-1]
            if entry in self._contents
            and entry.start_time not in unread_runs  # An unread file of the run may contain a trip.
            and not _overlaps_trip(self._contents[entry], self._contents.values())
        ]

    def _list_entries(self) -> list[FileEntry]:
        """Return the configuration's files, finished or not, oldest run first.

        Files of other users are left out, and counted in the text of `failure`. Raises OSError if the folder cannot be
        read.
        """
        files, foreign_names = [], []
        with os.scandir(self._folder) as entries:
            for entry in entries:
                match = self._pattern.fullmatch(entry.name)
                if not match or not entry.is_file(follow_symlinks=False):
                    continue
                if not is_own(Path(entry)):
                    foreign_names.append(entry.name)
                    continue
                status, number = entry.stat(follow_symlinks=False), int(match[2] or 1)
                files.append(FileEntry(match[1], number, entry.name, status.st_size, status.st_mtime_ns))
        if foreign_names:
            foreign_text = f"{count_text(len(foreign_names), 'recording')} of other users, such as {min(foreign_names)}"
            self.failure = (
                f"{self._folder}: {foreign_text}: these files do not count for recording.keep_gib and are never removed"
            )
        return sorted(files)

    def _read_new_files(self, entries: list[FileEntry], budget_s: float) -> None:
        """Read and store the contents of finished files in `entries` that are new, oldest first.

        Begins no file later than `budget_s` after the call. Files that are no longer in `entries` are forgotten.
        """
        until_s = timing.monotonic_s() + budget_s
        self._contents = {entry: self._contents[entry] for entry in entries if entry in self._contents}
        self._unusable &= set(entries)
        for entry in entries:
            is_new = entry not in self._contents and entry not in self._unusable and entry.name.endswith(".mcap")
            if is_new and timing.monotonic_s() < until_s:
                if (contents := self._read_contents(entry)) is None:
                    self._unusable.add(entry)
                else:
                    self._contents[entry] = contents

    def _read_contents(self, entry: FileEntry) -> FileContents | None:
        """Return the contents of a file; None if it is unreadable, damaged, unfinished, cut, imported, or of another
        configuration.
        """
        try:
            with Reader(self._folder / entry.name, opener=open_own) as reader:
                header, totals = reader.header, reader.totals
                if totals is None or header["name"] != self._name or any(map(header.get, DERIVED_FILE_KEYS)):
                    return None
                event_window = EventWindow.from_header(header)
                before_s, after_s = (
                    (event_window.before_s, event_window.after_s) if event_window else (BEFORE_S, AFTER_S)
                )
                ticks = [event["tick"] for event in reader.events if event["kind"] in ("tripped", "driver_failed")]
                rate_hz = header["rate_hz"]
                trips = tuple((tick - round(before_s * rate_hz), tick + round(after_s * rate_hz)) for tick in ticks)
                run = (header["name"], header["created_unix_ns"])
                if reader.problems:
                    return None
                return FileContents(run, reader.first_tick, totals["ticks_executed"], trips)
        except RtloopError:
            return None


def _overlaps_trip(file: FileContents, stored: Iterable[FileContents]) -> bool:
    """Whether the file has ticks in one of the ranges `trips` of its run; `stored` are the contents of all files."""
    trips = [trip for candidate in stored if candidate.run == file.run for trip in candidate.trips]
    return any(first < file.end and last >= file.first for first, last in trips)

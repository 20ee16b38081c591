"""The folder of recordings: a summary of each file, and paths of files in that folder alone."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from rtloop.errors import RtloopError
from rtloop.foundation import timing
from rtloop.foundation.trusted import open_without_link
from rtloop.recording.cutting.seek import ChunkSeeker
from rtloop.recording.file.reader import Reader

ENDINGS = (".mcap", ".mcap.part")
MAX_LISTED = 500
"""Most files in a listing, the newest ones."""
BUDGET_S = 1.5
"""Time for opening new files in one listing; the other new files show their size alone until the next listing."""
MAX_COUNTED_BYTES = 64 << 20
"""Size of a file above which trips are not counted, because all its events would have to be read."""
UNKNOWN_SUMMARY: Mapping[str, object] = dict.fromkeys(
    ("complete", "ticks", "duration_s", "created_unix_s", "begins_unix_s", "trips", "cut", "around")
)


class RecordingFile(NamedTuple):
    """A file in the folder of recordings."""

    name: str
    bytes: int
    modified_ns: int


def shown_name(name: str) -> str:
    """Return a file's name as pages show and send it: bytes that are not UTF-8 become \\xNN."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


class RecordingFolder:
    """The recordings in `folder`."""

    def __init__(self, folder: Path) -> None:
        """Store the folder, which need not exist; no file is read yet."""
        self.folder = folder
        self._summaries: dict[RecordingFile, Mapping[str, object]] = {}
        self._lock = timing.lock()

    def listing(self) -> list[dict[str, object]]:
        """Return a dictionary for each of the newest MAX_LISTED recordings, the newest first.

        Keys: file (`shown_name`), bytes (size), captured (whether a capture made it), complete (whether its end is
        recorded and no tick of it is lost), ticks and trips (numbers), duration_s, created_unix_s, begins_unix_s (time
        of the first tick), cut ({first, end, files}: ticks and files from which a cut was made, else None), around
        (whether only ticks around events are in it). A value is None if it is unknown, or not read yet: a call reads
        new files for BUDGET_S, the other files wait for a later call.
        """
        with self._lock:
            files = sorted(self._recording_files(), key=lambda file: file.modified_ns, reverse=True)[:MAX_LISTED]
            deadline_s = timing.monotonic_s() + BUDGET_S
            summaries = {}
            for file in files:
                if file in self._summaries:
                    summaries[file] = self._summaries[file]
                elif timing.monotonic_s() < deadline_s:
                    summaries[file] = _summary(self.folder / file.name, file.bytes)
            self._summaries = summaries
            return [
                {
                    "file": shown_name(file.name),
                    "bytes": file.bytes,
                    "captured": ".capture-" in file.name,
                    **summaries.get(file, UNKNOWN_SUMMARY),
                }
                for file in files
            ]

    def path(self, name: str) -> Path | None:
        """Return the path of a recording by its name in the listing; None for any other name or path.

        A file of exactly this name has priority over a file whose shown name is equal.
        """
        names = [file.name for file in self._recording_files()]
        match = name if name in names else next((file for file in names if shown_name(file) == name), None)
        return None if match is None else self.folder / match

    def _recording_files(self) -> list[RecordingFile]:
        """Return the recordings in the folder, without links, in no order; [] if the folder does not exist yet.

        A file that is removed meanwhile ends the list early.
        """
        files = []
        try:
            with os.scandir(self.folder) as entries:
                for entry in entries:
                    if entry.name.endswith(ENDINGS) and entry.is_file(follow_symlinks=False):
                        status = entry.stat(follow_symlinks=False)
                        files.append(RecordingFile(entry.name, status.st_size, status.st_mtime_ns))
        except OSError:
            return files  # The folder does not exist yet, or a file was removed meanwhile.
        return files


def _summary(path: Path, size: int) -> Mapping[str, object]:
    """Return the values of UNKNOWN_SUMMARY's keys, as `RecordingFolder.listing` describes them, from a recording.

    All values are None if the recording is unreadable; `trips` is None for a `size` (bytes) above MAX_COUNTED_BYTES.
    """
    try:
        with Reader(path, tolerant=True, opener=open_without_link) as reader:
            seeker, header, ticks, span_s, offset_s = ChunkSeeker(reader), reader.header, 0, 0.0, 0.0
            first_span, last_span, totals = seeker.first_span(), seeker.last_span(), seeker.final_totals()
            if first_span is not None and last_span is not None:
                ticks = last_span.last + 1 - first_span.first
                offset_s = first_span.first_ns / 1e9
                span_s = (last_span.last_ns - first_span.first_ns) / 1e9 + 1 / header["rate_hz"]
            events = reader.events if size <= MAX_COUNTED_BYTES else None
            return {
                "complete": bool(totals and totals["complete"]),
                "ticks": totals["ticks_logged"] if totals else ticks,
                "duration_s": span_s,
                "around": "around" in header,
                "created_unix_s": header["created_unix_ns"] / 1e9,
                "begins_unix_s": header["created_unix_ns"] / 1e9 + offset_s,
                "trips": None if events is None else sum(event["kind"] == "tripped" for event in events),
                "cut": header.get("cut"),
            }
    except RtloopError:
        return UNKNOWN_SUMMARY

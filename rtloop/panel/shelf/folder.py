"""The folder of recordings: what lies there, said in a line each, and nothing that lies elsewhere."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

from rtloop.errors import RtloopError
from rtloop.foundation.trusted import open_without_link
from rtloop.recording.cutting.seek import ChunkSeeker
from rtloop.recording.file.reader import Reader

ENDINGS = (".mcap", ".mcap.part")
MAX_LISTED = 500
"""The newest ones."""
BUDGET_S = 1.5
"""For opening files that were not seen before; of those that are left there is the size alone, until the next time."""
MAX_COUNTED_BYTES = 64 << 20
"""Of larger files the trips are not counted: for that all of their events would be read."""
UNKNOWN_SUMMARY: dict[str, Any] = dict.fromkeys(
    ("complete", "ticks", "duration_s", "created_unix_s", "trips", "cut", "around")
)


class RecordingFile(NamedTuple):
    """A file as it lies there."""

    name: str
    bytes: int
    modified_ns: int


def shown_name(name: str) -> str:
    """A file's name as pages show and send it: bytes that are no UTF-8 are escaped as \\xNN."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


class RecordingFolder:
    """The recordings in `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._summaries: dict[RecordingFile, dict[str, Any]] = {}
        self._lock = threading.Lock()

    def listing(self) -> list[dict[str, Any]]:
        """The newest first: {file, bytes, captured, complete, ticks, duration_s, created_unix_s, trips, cut,
        around}.

        What is not known, or not yet, is None.
        """
        with self._lock:
            files = sorted(self._recording_files(), key=lambda file: file.modified_ns, reverse=True)[:MAX_LISTED]
            deadline_s = time.monotonic() + BUDGET_S
            summaries = {}
            for file in files:
                if file in self._summaries:
                    summaries[file] = self._summaries[file]
                elif time.monotonic() < deadline_s:
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
        """Of a recording by its name in the listing; None for everything else, wherever it may point.

        A file of exactly this name goes before one whose name is escaped to it.
        """
        names = [file.name for file in self._recording_files()]
        match = name if name in names else next((file for file in names if shown_name(file) == name), None)
        return None if match is None else self.folder / match

    def _recording_files(self) -> list[RecordingFile]:
        files = []
        try:
            with os.scandir(self.folder) as entries:
                for entry in entries:
                    if entry.name.endswith(ENDINGS) and entry.is_file(follow_symlinks=False):
                        status = entry.stat(follow_symlinks=False)
                        files.append(RecordingFile(entry.name, status.st_size, status.st_mtime_ns))
        except OSError:
            return files  # the folder is not there yet, or a file went away
        return files


def _summary(path: Path, size: int) -> dict[str, Any]:
    """Of one file, from its beginning and its end."""
    try:
        with Reader(path, tolerant=True, opener=open_without_link) as reader:
            seeker = ChunkSeeker(reader)
            first_span, last_span, totals, ticks, span_s = (
                seeker.first_span(),
                seeker.last_span(),
                seeker.final_totals(),
                0,
                0.0,
            )
            if first_span is not None and last_span is not None:
                ticks = last_span.last + 1 - first_span.first
                span_s = (last_span.last_ns - first_span.first_ns) / 1e9 + 1 / reader.header["rate_hz"]
            events = reader.events if size <= MAX_COUNTED_BYTES else None
            return {
                "complete": bool(totals and totals["complete"]),
                "ticks": totals["ticks_logged"] if totals else ticks,
                "duration_s": span_s,
                "around": "around" in reader.header,
                "created_unix_s": reader.header["created_unix_ns"] / 1e9,
                "trips": None if events is None else sum(event["kind"] == "tripped" for event in events),
                "cut": reader.header.get("cut"),
            }
    except RtloopError:
        return UNKNOWN_SUMMARY

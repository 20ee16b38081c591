"""Verdicts of an archive's recordings, in memory and as lines of JSON in a folder, from which a later call continues.

A line has the keys path, files, size, mtime_ns, rtloop (the version), sha256 (of the recording's content), verdict, the
columns of the examination, reason, and check (of the line). It is on the disk before the next one is written. A line
does not count if it is damaged, if the content of its recording has changed since, if another version of rtloop wrote
it, or if its verdict is one of REPEATED.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rtloop.campaigns.archive_files import ArchivedRecording
from rtloop.campaigns.archive_verdict import CRASHED, NO_LAW, OTHER_VERSION, UNFINISHED, UNREADABLE, Row
from rtloop.errors import UnavailableError, output_errors
from rtloop.foundation.trusted import close_descriptor, open_own, overwrite_file, replace_file
from rtloop.version import __version__

LOCK = "archive.lock"
REPEATED = (UNREADABLE, NO_LAW, OTHER_VERSION, UNFINISHED, CRASHED)
"""Verdicts that may change although the file does not: by its permissions, an installed law, the end of a recorder, a
quieter machine."""
CHECK = "check"


class VerdictTable:
    """Rows of `recordings` by path; with `folder`, they are appended to its file `file_name`.

    A row that the file already has becomes one of `rows` once `add` gets the digest of the recording's present content.
    Raises UnavailableError if another process writes to the folder, OutputError if the system refuses.
    """

    def __init__(
        self, recordings: Sequence[ArchivedRecording], columns: Sequence[str], folder: Path | None, file_name: str
    ) -> None:
        """Make and lock `folder`, and read the stored rows there; without a folder there are none.

        `columns` are the names of the columns of the examination. A stored row with a verdict of REPEATED, which may
        change without the recording, is left out. Raises UnavailableError if another process writes to the folder,
        OutputError if the system refuses.
        """
        self._recordings, self._columns = recordings, columns
        self.rows: dict[str, Row] = {}
        self.confirmed = 0
        """Number of `rows` that were stored earlier."""
        self._stored: dict[str, Row] = {}
        self.path = None if folder is None else folder / file_name
        self._lock = self._file = -1
        if folder is None or self.path is None:
            return
        with output_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = overwrite_file(folder / LOCK)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.close()
            raise UnavailableError(
                f"{folder}: another `rtloop archive` writes its results to this folder; wait until it ends, or choose "
                "another folder with --out"
            ) from None
        try:
            self._open(self.path)
        except BaseException:
            self.close()
            raise

    def _open(self, path: Path) -> None:
        """Read the stored rows, and write them to a new file that replaces the old one. Raises OutputError.

        The new file has one line for each path, no damaged line, and no verdict of REPEATED.
        """
        with output_errors(path):
            stored = {name: row for name, row in _read_rows(path).items() if row["verdict"] not in REPEATED}
            part = path.with_name(f".{path.name}.part")
            self._file = replace_file(part)
            self._append(stored.values())
            part.replace(path)
        self._stored = {name: row for name, row in stored.items() if row.get("rtloop") == __version__}

    def close(self) -> None:
        """Close the file and release the lock, if there are any, so that other processes may write to the folder."""
        for descriptor in (self._file, self._lock):
            if descriptor >= 0:
                close_descriptor(descriptor)

    def missing(self) -> list[ArchivedRecording]:
        """Return the recordings that have no row, in the order in which the table got them."""
        return [recording for recording in self._recordings if recording.paths[0] not in self.rows]

    def stored_sha256(self, recording: ArchivedRecording) -> str | None:
        """Return the digest of the content that the stored row of a recording judges; None without such a row."""
        row = self._stored.get(recording.paths[0], {})
        return row.get("sha256") if row.get("files") == len(recording.paths) else None

    def add(self, recording: ArchivedRecording, values: Row) -> None:
        """Append the row of a recording to the file, if there is one, then store it in `rows`.

        Columns that `values` lacks are None. `values` with `stored_sha256` and without a verdict confirm the stored
        row. Raises OutputError if the system refuses; `rows` is unchanged then.
        """
        if "verdict" not in values:
            self.rows[recording.paths[0]] = {**self._stored[recording.paths[0]], **_facts(recording)}
            self.confirmed += 1
            return
        row = {**self._empty(recording), **values}
        if self.path is not None:
            with output_errors(self.path):
                self._append([row])
        self.rows[recording.paths[0]] = row

    def _empty(self, recording: ArchivedRecording) -> Row:
        """Return the row of a recording without a verdict: None in all columns of the examination, reason ""."""
        facts = {**_facts(recording), "sha256": None}
        return {**facts, "verdict": None, **dict.fromkeys(self._columns), "reason": ""}

    def ordered_rows(self) -> list[Row]:
        """Return the rows in the order of the recordings; a recording without a row is left out."""
        return [self.rows[recording.paths[0]] for recording in self._recordings if recording.paths[0] in self.rows]

    def counts(self) -> dict[str, int]:
        """Return the number of rows by verdict, the most frequent verdict first."""
        return dict(Counter(row["verdict"] for row in self.ordered_rows()).most_common())

    def _append(self, rows: Iterable[Row]) -> None:
        """Append rows to the file, which must be open, and wait until they are on the disk. Raises OSError."""
        content = "".join(json.dumps({**row, CHECK: _check(row)}) + "\n" for row in rows).encode()
        while content:
            content = content[os.write(self._file, content) :]
        os.fsync(self._file)


def _facts(recording: ArchivedRecording) -> Row:
    """Return the first values of a recording's row: path, files, size, mtime_ns, rtloop."""
    return {
        "path": recording.paths[0],
        "files": len(recording.paths),
        "size": recording.size,
        "mtime_ns": recording.mtime_ns,
        "rtloop": __version__,
    }


def _check(row: Row) -> str:
    """Return the digest by which damage to the line of a row is found."""
    return hashlib.sha256(json.dumps(row, sort_keys=True).encode()).hexdigest()[:16]


def _read_rows(path: Path) -> dict[str, Row]:
    """Return the stored rows by path, the last row of each path; {} without a file.

    A damaged line, such as one that was cut off, is left out. Raises OSError if the file cannot be read.
    """
    try:
        with os.fdopen(open_own(path), "rb") as file:
            lines = file.read().splitlines()
    except FileNotFoundError:
        return {}
    rows = filter(None, map(_parse_row, lines))
    return {row["path"]: row for row in rows}


def _parse_row(line: bytes) -> Row | None:
    """Return the row in a line; None if it is not a JSON object with a text `path` and `verdict` and a right check."""
    try:
        row = json.loads(line)
    except ValueError:
        return None
    is_row = isinstance(row, dict) and isinstance(row.get("path"), str) and isinstance(row.get("verdict"), str)
    return row if is_row and row.pop(CHECK, None) == _check(row) else None


@contextmanager
def open_table(
    recordings: Sequence[ArchivedRecording], columns: Sequence[str], folder: Path | None, file_name: str
) -> Iterator[VerdictTable]:
    """Open the table of recordings for a block, then close it. Raises as VerdictTable."""
    table = VerdictTable(recordings, columns, folder, file_name)
    try:
        yield table
    finally:
        table.close()

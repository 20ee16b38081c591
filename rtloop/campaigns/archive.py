"""Archives: thousands of recordings, each replayed or summarised in a worker, with one verdict for each.

A recording that cannot be read, or that kills its worker, gets its verdict like any other one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from rtloop.campaigns.archive_files import ArchivedRecording
from rtloop.campaigns.archive_table import VerdictTable, open_table
from rtloop.campaigns.archive_verdict import CRASHED, Examination, Row
from rtloop.campaigns.dispatcher import Dispatcher, Task
from rtloop.campaigns.workers import Workers
from rtloop.version import __version__


def examine(
    examination: Examination,
    recordings: Sequence[ArchivedRecording],
    workers: Workers,
    folder: Path | None,
    on_progress: Callable[[int], None],
    is_stop_requested: Callable[[], bool],
) -> dict[str, Any]:
    """Examine recordings on workers; with `folder`, store their rows in its file, and use the rows that count there.

    A stored row counts if the recording has the same bytes, this version of rtloop wrote the row, and its verdict
    depends on the recording alone. A recording whose row counts is read for its digest and not examined again.
    Returns {recordings, pending, stored, counts, duration_s, rate_per_s, verdicts}: `verdicts` is the list of rows, in
    the order of `recordings`, `counts` the number of rows by verdict, `stored` the number of rows from earlier calls,
    `pending` the number of recordings without a row after a stop. A row is {path, files, size, mtime_ns, rtloop,
    sha256, verdict, the columns of the examination, reason}.
    After a request to stop, the recordings that were submitted end and no other one starts. `on_progress` receives the
    number of rows.

    Raises UnavailableError if the scheduler is gone, a worker has another version or another process uses the folder,
    OutputError if the folder or a row cannot be written. Rows that were stored before the error stay in `folder`.
    """
    start_s = time.monotonic()
    with open_table(recordings, examination.columns, folder, examination.file_name) as table:
        Archive(examination, table, workers).run(on_progress, is_stop_requested)
        duration_s = time.monotonic() - start_s
        return {
            "recordings": len(recordings),
            "pending": len(table.missing()),
            "stored": table.confirmed,
            "counts": table.counts(),
            "duration_s": duration_s,
            "rate_per_s": (len(table.rows) - table.confirmed) / duration_s,
            "verdicts": table.ordered_rows(),
        }


class Archive:
    """Examines the recordings of `table` on `workers`."""

    def __init__(self, examination: Examination, table: VerdictTable, workers: Workers) -> None:
        """Store the arguments; `run` begins the work."""
        self._examination, self._table, self._workers = examination, table, workers

    def run(self, on_progress: Callable[[int], None], is_stop_requested: Callable[[], bool]) -> None:
        """Examine the recordings, and add or confirm their rows; `on_progress` receives the number of rows.

        After a request to stop, the recordings that were submitted end and no other one starts. Raises UnavailableError
        if the scheduler is gone or a worker has another version, OutputError if a verdict cannot be stored.
        """
        tasks = [Task((recording,)) for recording in self._table.missing()]
        on_progress(0)
        Dispatcher(self._workers, self).run(tasks, on_progress, is_stop_requested)

    def submit(self, items: tuple[ArchivedRecording, ...]) -> Future[Row]:
        """Start the examination of one recording in a worker; return the future of its row."""
        stored_sha256 = self._table.stored_sha256(items[0])
        return self._workers.submit(self._examination.function, items[0].paths, __version__, stored_sha256)

    def store(self, items: tuple[ArchivedRecording, ...], result: Row) -> None:
        """Add `result`, the row of the single recording in `items`, to the table and its file. Raises OutputError."""
        self._table.add(items[0], result)

    def set_aside(self, item: ArchivedRecording) -> None:
        """Add a row with verdict CRASHED to the table and its file: each worker that examined `item` died.

        Raises OutputError if the system refuses.
        """
        self._table.add(item, {"verdict": CRASHED, "reason": "each worker process that examined this recording died"})

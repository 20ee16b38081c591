"""Cut a range of ticks out of a recording, as a recording that replays alone.

The new recording begins at the newest snapshot of the law at or before the range, from which a replay can verify every
tick. Ticks, snapshots and events are copied bit for bit.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rtloop.recording.cutting.seek import ChunkSeeker
from rtloop.recording.cutting.source import RunSource, TickRange
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.copy_account import CopyAccount
from rtloop.recording.file.recover import remove_leftover
from rtloop.recording.file.run_readers import RecordingPaths, ReportTicks, find_files, open_run
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import CUT, GAP
from rtloop.recording.file.topics.overview import Range, uncovered_ranges
from rtloop.recording.file.writer import Writer

UNFINISHED_SUFFIX = ".cutting"


class RangeCopy:
    """Copy of a range of ticks into `writer`."""

    def __init__(self, source: RunSource, writer: Writer, tick_range: TickRange) -> None:
        """Prepare to copy `tick_range` from `source` to `writer`, which has written its header."""
        self._source, self._writer, self._range = source, writer, tick_range
        self._account = CopyAccount(tick_range.first, source.header["rate_hz"])
        self.gaps: list[tuple[int, int]] = []
        """Missing ranges (first tick, count), set by `run`."""
        self._recorded_gaps: list[dict[str, int]] = []
        self._skipped_ranges: list[Range] = []

    def run(self, progress: ReportTicks | None) -> None:
        """Copy all ticks and messages of the range, in the order of the files, and set `gaps`.

        `progress` receives the number of copied ticks. Raises OutputError if a write fails, RecordingError if the
        source cannot be read.
        """
        for messages, rows in self._source.contents(self._range):
            self._writer.write_messages(messages)
            self._writer.write_ticks(rows)
            self._skipped_ranges += self._source.skipped_ranges(messages)
            self._recorded_gaps += [gap for message in messages if (gap := _recorded_gap(message))]
            if len(rows):
                self._account.add_rows(rows)
            if progress:
                progress(self._writer.ticks)
        next_tick, end = self._account.next_tick, self._range.end
        self.gaps = [
            piece
            for first, count in [*self._account.gaps, (next_tick, end - next_tick)]
            for piece in uncovered_ranges(first, first + count, self._skipped_ranges)
        ]

    @property
    def unexplained_ticks(self) -> int:
        """Number of missing ticks without a gap event: their chunk is damaged, or their file is missing."""
        return sum(count for _, count in self.gaps) - sum(
            max(min(first + count, gap["first_tick"] + gap["count"]) - max(first, gap["first_tick"]), 0)
            for first, count in self.gaps
            for gap in self._recorded_gaps
        )

    def final_message(self, ticks_logged: int) -> Message:
        """Return the event CUT that ends the file, with the totals if it holds `ticks_logged` ticks; after `run`."""
        skipped = self._writer.ticks_skipped
        lost = self._range.end - self._range.first - ticks_logged - skipped
        totals = {"ticks_executed": self._range.end, "ticks_logged": ticks_logged, "ticks_lost": lost, "events_lost": 0}
        totals |= {"ticks_skipped": skipped} if self._source.header.get("around") else {}
        problems = self._source.problems
        details = totals | {"result": CUT, "complete": lost == 0 and not problems, "problems": problems}
        return self._account.end_message(CUT, self._range.end, details, self._writer.start_unix_ns)


def cut(
    files: RecordingPaths,
    first: int | None = None,
    end: int | None = None,
    output: Path | None = None,
    *,
    from_s: float | None = None,
    until_s: float | None = None,
    min_free_bytes: int = 0,
    progress: ReportTicks | None = None,
) -> dict[str, object]:
    """Write the ticks from `first` to before `end` of a recording, finished, rotated or growing, as a recording.

    `from_s` replaces `first`, `until_s` replaces `end`: each, in s since the start of the run, stands for the first
    tick due then or later. A limit that is None is the recording's. The ticks from the newest snapshot of the law at or
    before the range are copied as well. `output` is by default NAME.cut-TICK.mcap beside the recording. At least
    `min_free_bytes` of the disk stay free. `progress` receives the number of copied ticks.

    Returns {recording, output, first, end, begin, ticks, gaps [(first tick, count)], problems, complete}: `first` and
    `end` are the requested limits, `begin` is the first copied tick, `ticks` the number of copied ones, `gaps` lists
    the missing ticks, `complete` tells whether there is no gap and no damage. Raises
    RecordingError for files that are no recording of one run, and for a range that is not in it or has no snapshot to
    begin from; OutputError for an output that exists or cannot be written. After an error no new file is left.
    """
    with open_run(find_files(files)) as readers:
        source = RunSource([ChunkSeeker(reader) for reader in readers])
        requested_range = _requested_range(source, first, end, from_s, until_s)
        copied_range = source.replayable_range(requested_range)
        output = output or cut_path(source.path, requested_range.first)
        header = source.header | {
            "first_tick": copied_range.first,
            "ticks_expected": copied_range.end - copied_range.first,
            "cut": {
                "first": requested_range.first,
                "end": requested_range.end,
                "files": source.file_names(copied_range),
            },
        }
        copy, ticks = _write_copy(source, copied_range, header, output, min_free_bytes, progress)
        problems = [*source.problems]
        if copy.unexplained_ticks:
            problems.append(
                f"{copy.unexplained_ticks} recorded ticks are missing: they are damaged, or in a file of the run that "
                "was not given"
            )
        return {
            "recording": str(source.path),
            "output": str(output),
            "first": requested_range.first,
            "end": requested_range.end,
            "begin": copied_range.first,
            "ticks": ticks,
            "gaps": copy.gaps,
            "problems": problems,
            "complete": not copy.gaps and not source.problems,
        }


def cut_path(path: Path, tick: int, kind: str = "cut") -> Path:
    """Path NAME.KIND-TICK.mcap of a cut beside its recording NAME.mcap, or NAME.mcap.part.

    It does not match the pattern `NAME-*.mcap` of the run's own files.
    """
    return path.with_name(f"{path.name.removesuffix('.part').removesuffix('.mcap')}.{kind}-{tick}.mcap")


def _requested_range(
    source: RunSource, first: int | None, end: int | None, from_s: float | None, until_s: float | None
) -> TickRange:
    """Return the range of ticks that the arguments of `cut` request; a time that is not None replaces its tick.

    Raises RecordingError for an empty range, or one that is not wholly in the recording.
    """
    full_range = source.full_range
    if from_s is not None:
        first = source.first_tick_due(from_s)
    if until_s is not None:
        end = source.first_tick_due_or_skipped(until_s)
    requested = TickRange(full_range.first if first is None else first, full_range.end if end is None else end)
    label = f"{source.path}: ticks from {requested.first} to before {requested.end}"
    if not requested.first < requested.end:
        raise RecordingError(f"{label} are an empty range; allowed: an end after the beginning")
    if requested.first < full_range.first or requested.end > full_range.end:
        raise RecordingError(
            f"{label} are not in the recording; allowed: ticks {full_range.first} to {full_range.end - 1}"
        )
    return requested


def _write_copy(
    source: RunSource,
    tick_range: TickRange,
    header: dict[str, Any],
    output: Path,
    min_free_bytes: int,
    progress: ReportTicks | None,
) -> tuple[RangeCopy, int]:
    """Copy a range of ticks into the new recording `output`. Returns the copy and its number of ticks.

    An unfinished output of an earlier attempt is removed. Raises OutputError if the output exists, another process is
    writing it or it cannot be written, RecordingError if the source cannot be read; no new output is left then.
    """
    remove_leftover(output, UNFINISHED_SUFFIX)
    log_time = header["created_unix_ns"] if header["paced"] else 0
    writer = Writer(
        output, header, log_time, message_index=True, min_free_bytes=min_free_bytes, suffix=UNFINISHED_SUFFIX
    )
    try:
        writer.start_unix_ns = source.start_unix_ns
        copy = RangeCopy(source, writer, tick_range)
        copy.run(progress)
        writer.finish(copy.final_message, require_all=True)
    except BaseException:
        writer.discard()
        raise
    return copy, writer.ticks


def _recorded_gap(message: Message) -> dict[str, int] | None:
    """Gap {first_tick, count} in a gap event of the recorder; None for any other message."""
    if message.channel != format.EVENTS:
        return None
    event = json.loads(message.payload)
    return event["what"] if event["kind"] == GAP else None

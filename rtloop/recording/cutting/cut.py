"""A stretch of a recording as a recording of its own, which replays by itself; nothing is computed anew.

It begins at the newest snapshot of the law at or before the stretch, as the parts of a rotated recording do: from
there on a replay can tell every tick. Ticks are copied bit for bit, snapshots and events as they are.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rtloop.errors import writing
from rtloop.recording.cutting.seek import Seeker
from rtloop.recording.cutting.source import Source, Stretch
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.parts import Files, Parts, find_files
from rtloop.recording.file.reader import Rows
from rtloop.recording.file.recover import Progress, grows
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.events import CUT, GAP, recorder_event
from rtloop.recording.file.topics.overview import Range, uncovered
from rtloop.recording.file.topics.ticks import missing
from rtloop.recording.file.writer import Writer
from rtloop.signals import DEADLINE, TICK

UNFINISHED = ".cutting"


class Copy:
    """Copies a stretch into `writer`, and keeps account."""

    def __init__(self, source: Source, writer: Writer, stretch: Stretch) -> None:
        self._source, self._writer, self._stretch = source, writer, stretch
        self._next, self._end_ns = stretch.first, 0.0
        self.gaps: list[tuple[int, int]] = []
        """(first tick, how many) of what is missing."""
        self._said: list[dict[str, Any]] = []
        self._skipped: list[Range] = []

    def run(self, progress: Progress | None) -> None:
        """All of it, in order."""
        for messages, rows in self._source.contents(self._stretch):
            self._writer.write_messages(messages)
            self._writer.write_ticks(rows)
            self._skipped += self._source.skipped(messages)
            self._said += [gap for message in messages if (gap := _gap(message))]
            if len(rows):
                self._note(rows)
            if progress:
                progress(self._writer.ticks)
        if self._next < self._stretch.end:
            self.gaps.append((self._next, self._stretch.end - self._next))
        self.gaps = [piece for first, count in self.gaps for piece in uncovered(first, first + count, self._skipped)]

    @property
    def unexplained(self) -> int:
        """Missing ticks of which the recorder says nothing: what held them is damaged, or was lost with a file."""
        return sum(count for _, count in self.gaps) - sum(
            max(min(first + count, gap["first_tick"] + gap["count"]) - max(first, gap["first_tick"]), 0)
            for first, count in self.gaps
            for gap in self._said
        )

    def final(self, logged: int) -> Message:
        """The event that ends the file."""
        skipped = self._writer.skipped
        lost = self._stretch.end - self._stretch.first - logged - skipped
        totals = {"ticks_executed": self._stretch.end, "ticks_logged": logged, "ticks_lost": lost, "events_lost": 0}
        totals |= {"ticks_skipped": skipped} if self._source.header.get("around") else {}
        problems = self._source.problems
        details = totals | {"result": CUT, "complete": lost == 0 and not problems, "problems": problems}
        event = recorder_event(CUT, self._stretch.end, round(self._end_ns), details)
        return Message(format.EVENTS, self._writer.start_unix_ns + round(self._end_ns), json.dumps(event).encode())

    def _note(self, rows: Rows) -> None:
        self.gaps += missing(rows[:, TICK], self._next)
        self._next = int(rows[-1, TICK]) + 1
        self._end_ns = float(rows[-1, DEADLINE]) + 1e9 / self._source.header["rate_hz"]


def cut(
    files: Files,
    first: int | None = None,
    end: int | None = None,
    output: Path | None = None,
    *,
    from_s: float | None = None,
    until_s: float | None = None,
    min_free_bytes: int = 0,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the ticks from `first` to before `end` of a recording, whole, rotated or still growing, as one of its own.

    `from_s` and `until_s` say the same in s since the start; without either it begins with the recording, or ends
    with it. What is in front, back to the snapshot that it begins at, comes with it. Lost ticks stay lost and are
    said. `output` is NAME.cut-TICK.mcap beside the recording by default; less than `min_free_bytes` are never left
    free. `progress` is told the ticks so far.

    Returns {recording, output, first, end, begin, ticks, gaps [(first tick, count)], problems, complete}. Raises
    RecordingError for a stretch that is not in the recording or has no snapshot to begin from, OutputError for an
    output that exists or cannot be written.
    """
    with Parts(find_files(files)) as readers:
        source = Source([Seeker(reader) for reader in readers])
        requested_range = _asked(source, first, end, from_s, until_s)
        copied_range = source.kept(requested_range)
        output = output or cut_path(source.path, requested_range.first)
        header = source.header | {
            "first_tick": copied_range.first,
            "ticks_expected": copied_range.end - copied_range.first,
            "cut": {"first": requested_range.first, "end": requested_range.end, "files": source.files(copied_range)},
        }
        copy, ticks = _write(source, copied_range, header, output, min_free_bytes, progress)
        problems = [*source.problems]
        if copy.unexplained:
            problems.append(f"{copy.unexplained} of its ticks are not in the recording, and no gap says why")
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
    """What a stretch is called: beside its recording, and in no pattern `NAME-*.mcap` of the run's own files."""
    return path.with_name(f"{path.name.removesuffix('.part').removesuffix('.mcap')}.{kind}-{tick}.mcap")


def _asked(source: Source, first: int | None, end: int | None, from_s: float | None, until_s: float | None) -> Stretch:
    """The stretch that is meant. Raises RecordingError."""
    full_range = source.whole
    if from_s is not None:
        first = source.due(from_s)
    if until_s is not None:
        end = source.due_or_skipped(until_s)
    requested = Stretch(full_range.first if first is None else first, full_range.end if end is None else end)
    label = f"{source.path}: ticks from {requested.first} to before {requested.end}"
    if not requested.first < requested.end:
        raise RecordingError(f"{label}: no stretch; the end comes behind the beginning")
    if requested.first < full_range.first or requested.end > full_range.end:
        raise RecordingError(f"{label}: not in the recording; ticks {full_range.first} to {full_range.end - 1} are")
    return requested


def _write(
    source: Source, stretch: Stretch, header: dict[str, Any], output: Path, least: int, progress: Progress | None
) -> tuple[Copy, int]:
    """The copy, and the ticks in it. Raises OutputError, RecordingError; nothing of the output is left then."""
    unfinished_path = output.with_name(output.name + UNFINISHED)
    with writing(output):
        if unfinished_path.exists() and not grows(unfinished_path):
            unfinished_path.unlink()
    log_time = header["created_unix_ns"] if header["paced"] else 0
    writer = Writer(output, header, log_time, message_index=True, min_free_bytes=least, suffix=UNFINISHED)
    try:
        writer.start_unix_ns = source.start_unix_ns
        copy = Copy(source, writer, stretch)
        copy.run(progress)
        writer.finish(copy.final, whole=True)
    except BaseException:
        writer.discard()
        raise
    return copy, writer.ticks


def _gap(message: Message) -> dict[str, Any] | None:
    """What a message says of missing ticks."""
    if message.channel != format.EVENTS:
        return None
    event = json.loads(message.payload)
    return event["what"] if event["kind"] == GAP else None

"""Replay of a whole recording in spans at once, one process each.

A cut between two spans is a place in the files: a chunk, and in it the tick of a snapshot. The earlier span executes
all chunks up to that one, in the order of the files, and in it the ticks up to the snapshot, whose state it compares in
bytes; the later span starts there. So no chunk is left out, whatever its ticks claim, and all spans together compare
the same data as a replay in one piece. Only a recording that is finished, complete and identical gets its answer here;
any other one is replayed in one piece, which finds the first difference and reports it.
"""

from __future__ import annotations

import multiprocessing
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import groupby
from multiprocessing.connection import Connection
from operator import itemgetter
from typing import NamedTuple

from rtloop import signals
from rtloop.errors import RtloopError
from rtloop.laws.registry import LawReference
from rtloop.recording.file.mcap.chunks import ChunkEntry
from rtloop.recording.file.reader import Reader, Snapshot
from rtloop.recording.file.run_readers import ReportTicks, open_run
from rtloop.recording.file.topics.events import GAP, RECOVERED
from rtloop.recording.file.topics.ticks import Ticks
from rtloop.recording.load import Recording
from rtloop.recording.replay.laws import NO_TRUST, TrustedLaws, recorded_laws
from rtloop.recording.replay.replay import Replay, misplaced_command, replay
from rtloop.recording.replay.rerun import Rows
from rtloop.recording.replay.verdict import ReplayReport, unjudged_contents

LEAST_CHUNKS = 8
"""Chunks of ticks of a span, at least: a process costs as much as the replay of a few of them."""


class Cut(NamedTuple):
    """The beginning of a span: its first `tick`, which has a snapshot, in chunk number `chunk`.

    Chunks with ticks are counted from 0 over all files.
    """

    chunk: int
    tick: int


class Span(NamedTuple):
    """Ticks from one cut up to and including that of the next one, which both spans execute; None for the last span."""

    begin: Cut
    end: Cut | None


class SpanCounts(NamedTuple):
    """Counts of an identical span: ticks, ticks of each file, and snapshots; then the tick after the last one.

    The tick of the next span's cut is left out.
    """

    ticks: int
    file_ticks: list[int]
    snapshots: int
    end_tick: int


def replay_on_cores(
    recording: Recording, progress: ReportTicks | None = None, trust: TrustedLaws = NO_TRUST, jobs: int = 1
) -> ReplayReport:
    """Replay a recording like `rtloop.recording.replay.replay.replay` does, with up to `jobs` processes at once.

    The report does not depend on `jobs`. Raises RecordingError and ConfigError as that function does.
    """
    laws = recorded_laws(recording, trust)
    report = _replay_in_spans(recording, laws, jobs, progress) if jobs > 1 else None
    return report or replay(recording, progress, trust)


def _replay_in_spans(
    recording: Recording, laws: Sequence[LawReference], jobs: int, progress: ReportTicks | None
) -> ReplayReport | None:
    """Return the report of a complete recording that is identical; None where a replay in one piece has to judge.

    `progress` receives the number of replayed ticks.
    """
    if not _is_plain(recording):
        return None
    totals = [extent.totals for extent in recording.extents if extent.totals]
    logged, ticks_executed = [total["ticks_logged"] for total in totals], totals[-1]["ticks_executed"]
    with closing(recording.snapshots()) as recorded:
        snapshot_ticks = [snapshot.tick for snapshot in recorded]
    inner_ticks = [tick for tick in snapshot_ticks if tick < ticks_executed]
    spans = _find_spans(recording, jobs, inner_ticks)
    if len(spans) < 2:
        return None
    counts = _run_spans(recording, laws, spans, progress)
    done = [count for count in counts if count is not None]
    ends = [*(span.end.tick for span in spans if span.end), ticks_executed]
    if [count.end_tick for count in done] != ends:
        return None
    ticks, snapshots = sum(count.ticks for count in done), sum(count.snapshots for count in done)
    file_ticks = [sum(numbers) for numbers in zip(*(count.file_ticks for count in done), strict=True)]
    # the first span starts from the first snapshot; one that follows the last tick is not compared
    compared = len(inner_ticks) - 1
    if ticks != sum(logged) or file_ticks != logged or snapshots != compared:
        return None
    if snapshot_ticks[-1] > ticks_executed or recording.problems:
        return None
    return ReplayReport(ticks=ticks, stretches=1, snapshots=snapshots, not_judged=unjudged_contents(recording.header))


def _is_plain(recording: Recording) -> bool:
    """Whether a recording may be replayed in spans: all its files are finished, and nothing in it needs an explanation.

    Excluded are recovered files, gaps, ticks that two files hold or that overviews replace, problems of the reader, and
    commands that are recorded twice, out of order or after the end.
    """
    return (
        all(extent.totals and extent.totals["result"] != RECOVERED for extent in recording.extents)
        and not any(extent.repeated for extent in recording.extents)
        and not recording.problems
        and not recording.skipped
        and not any(event["kind"] == GAP for event in recording.events)
        and misplaced_command(recording) is None
    )


def _find_spans(recording: Recording, jobs: int, snapshot_ticks: Sequence[int]) -> list[Span]:
    """Return up to `jobs` spans of about equally many chunks, at least LEAST_CHUNKS each.

    [] for fewer chunks in all, a damaged chunk in which a span would begin, or a first tick that has no snapshot or is
    not the first one of the recording. `snapshot_ticks` are the ticks of the snapshots, ascending, without a snapshot
    that follows the last tick.
    """
    with open_run(recording.paths) as readers:
        chunks = _tick_chunks(readers)
        count = min(jobs, len(chunks) // LEAST_CHUNKS)
        cuts: list[Cut] = []
        for number in range(count):
            cut = _find_cut(chunks, number * len(chunks) // count, snapshot_ticks)
            if number == 0 and cut != Cut(0, recording.extents[0].first_tick):
                return []
            if cut and (not cuts or cut.tick > cuts[-1].tick):
                cuts.append(cut)
    return [*map(Span, cuts, [*cuts[1:], None])]


def _tick_chunks(readers: Sequence[Reader]) -> list[tuple[Reader, ChunkEntry]]:
    """Return all chunks that may hold ticks, each with its reader; `readers` and chunks are in the order of the run."""
    return [(reader, entry) for reader in readers for entry in reader.tick_chunks]


def _find_cut(chunks: Sequence[tuple[Reader, ChunkEntry]], number: int, snapshot_ticks: Sequence[int]) -> Cut | None:
    """Return the first snapshot in chunk `number` or a later one, with the chunk that holds its tick.

    None without one, and for a damaged or missing chunk up to there.
    """
    tick = None
    for place, (reader, entry) in enumerate(chunks[number:], number):
        ticks = reader.chunk(entry)
        if not isinstance(ticks, Ticks):
            return None
        if tick is None:
            tick = next((tick for tick in snapshot_ticks if tick >= ticks.first), None)
        if tick is None or tick < ticks.first:
            return None
        if tick <= ticks.last:
            return Cut(place, tick)
    return None


def _run_spans(
    recording: Recording, laws: Sequence[LawReference], spans: Sequence[Span], progress: ReportTicks | None
) -> list[SpanCounts | None]:
    """Replay all spans at once: the first one in this process, each other one in a process of its own.

    Returns the counts of each span; None for a span that is not identical, or whose process died. At the end, also
    after an error, the other processes are killed.
    """
    context = multiprocessing.get_context("fork")
    ticks_done = context.RawArray("q", len(spans))

    def report(number: int, ticks: int) -> None:
        """Store the number of replayed ticks of a span; for the first span, pass the sum of all to `progress`."""
        ticks_done[number] = ticks
        if number == 0 and progress:
            progress(sum(ticks_done))

    def run(number: int, sender: Connection) -> None:
        """Replay span `number` in the present child process, and send its counts, or None, to `sender`."""
        sender.send(_replay_span(recording, laws, spans[number], lambda ticks: report(number, ticks)))
        sender.close()

    processes, receivers = [], []
    try:
        for number in range(1, len(spans)):
            receiver, sender = context.Pipe(duplex=False)
            process = context.Process(target=run, args=(number, sender), daemon=True)
            with warnings.catch_warnings():  # Python 3.12 warns of threads; those of numpy's libraries allow a fork
                warnings.simplefilter("ignore", DeprecationWarning)
                process.start()
            sender.close()
            processes.append(process)
            receivers.append(receiver)
        counts = [_replay_span(recording, laws, spans[0], lambda ticks: report(0, ticks))]
        return counts + [_received(receiver) for receiver in receivers]
    finally:
        for process in processes:
            process.kill()
            process.join()


def _received(receiver: Connection) -> SpanCounts | None:
    """Return the counts that a span's process sent; None if the span is not identical or the process died before."""
    try:
        return receiver.recv()
    except EOFError:
        return None


def _replay_span(
    recording: Recording, laws: Sequence[LawReference], span: Span, progress: ReportTicks
) -> SpanCounts | None:
    """Return the counts of a span; None unless every tick is there and identical, and so is each snapshot's state."""
    try:
        with closing(recording.snapshots()) as snapshots, open_run(recording.paths) as readers:
            span_replay = Replay(recording, laws, _within(snapshots, span), progress)
            file_ticks = [0] * len(readers)
            end_tick = span_replay.run_rows(_span_rows(readers, span, file_ticks), span.begin.tick)
            is_clean = not any(reader.problems or reader.left_out for reader in readers)
    except RtloopError:
        return None
    report = span_replay.report
    if end_tick is None or not report.identical or not is_clean:
        return None
    repeated = int(span.end is not None)
    return SpanCounts(report.ticks - repeated, file_ticks, report.snapshots, end_tick - repeated)


def _within(snapshots: Iterator[Snapshot], span: Span) -> Iterator[Snapshot]:
    """Yield those of `snapshots` (ascending) that belong to a span, both ends included."""
    for snapshot in snapshots:
        if span.end is not None and snapshot.tick > span.end.tick:
            return
        if snapshot.tick >= span.begin.tick:
            yield snapshot


def _span_rows(readers: Sequence[Reader], span: Span, file_ticks: list[int]) -> Iterator[Rows]:
    """Yield blocks of rows: all ticks of the chunks of a span, but of its first and last chunk only those inside it.

    `readers` are in the order of the run. Adds the number of ticks before the span's end to `file_ticks`, by file.
    """
    chunks, (begin, end) = _tick_chunks(readers), span
    parts = [(chunks[begin.chunk : end and end.chunk], False)] + ([([chunks[end.chunk]], True)] if end else [])
    is_first = True
    for part, is_last in parts:
        for reader, group in groupby(part, itemgetter(0)):
            for rows in reader.blocks(None, [entry for _, entry in group], ahead=False):
                if is_first:
                    rows, is_first = rows[int((rows[:, signals.TICK] < begin.tick).sum()) :], False
                if end and is_last:
                    rows = rows[: int((rows[:, signals.TICK] <= end.tick).sum())]
                file_ticks[readers.index(reader)] += len(rows) - is_last
                if len(rows):
                    yield rows

"""Replay of a whole recording in spans at once, one process each.

A span runs from the law's snapshot at its first tick, and ends by comparing its state with the snapshot from which the
next span starts, in bytes: all spans together compare the same data as a replay in one piece. Only a recording that is
finished, complete and identical gets its answer here; any other one is replayed in one piece, which finds the first
difference and reports it.
"""

from __future__ import annotations

import multiprocessing
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing
from multiprocessing.connection import Connection
from typing import NamedTuple

from rtloop import signals
from rtloop.errors import RtloopError
from rtloop.laws.registry import LawReference
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


class Span(NamedTuple):
    """Ticks from the snapshot at `first_tick` up to the one at `last_tick`, at which the next span begins.

    Both spans execute `last_tick`, which is None for the last span. `first_tick` lies in chunk number `chunk` or a
    later one; chunks with ticks are counted from 0 over all files.
    """

    chunk: int
    first_tick: int
    last_tick: int | None


class SpanCounts(NamedTuple):
    """Counts of an identical span without the next one's first tick: ticks, snapshots, and the tick after the last."""

    ticks: int
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
    ticks_logged, ticks_executed = sum(total["ticks_logged"] for total in totals), totals[-1]["ticks_executed"]
    with closing(recording.snapshots()) as recorded:
        snapshot_ticks = [snapshot.tick for snapshot in recorded]
    inner_ticks = [tick for tick in snapshot_ticks if tick < ticks_executed]
    spans = _find_spans(recording, jobs, inner_ticks)
    if len(spans) < 2:
        return None
    counts = _run_spans(recording, laws, spans, progress)
    if any(count is None for count in counts):
        return None
    done = [count for count in counts if count is not None]
    ends = [span.last_tick for span in spans[:-1]] + [ticks_executed]
    ticks, snapshots = sum(count.ticks for count in done), sum(count.snapshots for count in done)
    # the first span starts from the first snapshot; one that follows the last tick is not compared
    compared = len(inner_ticks) - 1
    if [count.end_tick for count in done] != ends or ticks != ticks_logged or snapshots != compared:
        return None
    if snapshot_ticks[-1] > ticks_executed:
        return None
    if recording.problems:
        return None
    return ReplayReport(ticks=ticks, stretches=1, snapshots=snapshots, not_judged=unjudged_contents(recording.header))


def _is_plain(recording: Recording) -> bool:
    """Whether a recording may be replayed in spans: all its files are finished, and nothing in it needs an explanation.

    Excluded are recovered files, gaps, ticks that two files hold or that overviews replace, problems of the reader, and
    commands that are recorded twice or out of order.
    """
    return (
        all(extent.totals and extent.totals["result"] != RECOVERED for extent in recording.extents)
        and not any(extent.repeated for extent in recording.extents)
        and not recording.problems
        and not recording.skipped
        and not any(event["kind"] == GAP for event in recording.events)
        and misplaced_command(recording.events) is None
    )


def _find_spans(recording: Recording, jobs: int, snapshot_ticks: Sequence[int]) -> list[Span]:
    """Return up to `jobs` spans of about equally many chunks, at least LEAST_CHUNKS each.

    [] for fewer chunks in all, a damaged chunk in which a span would begin, or a first tick without a snapshot.
    `snapshot_ticks` are the ticks of the snapshots, ascending, without a snapshot that follows the last tick.
    """
    starts: list[tuple[int, int]] = []
    with open_run(recording.paths) as readers:
        chunks = [(reader, entry) for reader in readers for entry in reader.tick_chunks]
        count = min(jobs, len(chunks) // LEAST_CHUNKS)
        for number in range(count):
            chunk = number * len(chunks) // count
            reader, entry = chunks[chunk]
            ticks = reader.chunk(entry)
            if not isinstance(ticks, Ticks):
                return []
            start = next((tick for tick in snapshot_ticks if tick >= ticks.first), None)
            if number == 0 and start != ticks.first:
                return []
            if start is not None and (not starts or start > starts[-1][1]):
                starts.append((chunk, start))
    ends = [*(start for _, start in starts[1:]), None]
    return [Span(chunk, first_tick, end) for (chunk, first_tick), end in zip(starts, ends, strict=False)]


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
            end_tick = span_replay.run_rows(_span_rows(readers, span), span.first_tick)
            is_clean = not any(reader.problems or reader.left_out for reader in readers)
    except RtloopError:
        return None
    report = span_replay.report
    if end_tick is None or not report.identical or not is_clean:
        return None
    if span.last_tick is None:
        return SpanCounts(report.ticks, report.snapshots, end_tick)
    return SpanCounts(report.ticks - 1, report.snapshots, end_tick - 1)


def _within(snapshots: Iterator[Snapshot], span: Span) -> Iterator[Snapshot]:
    """Yield those of `snapshots` (ascending) that belong to a span, both ends included."""
    for snapshot in snapshots:
        if span.last_tick is not None and snapshot.tick > span.last_tick:
            return
        if snapshot.tick >= span.first_tick:
            yield snapshot


def _span_rows(readers: Sequence[Reader], span: Span) -> Iterator[Rows]:
    """Yield blocks of rows for the ticks of a span, both ends included; `readers` are in the order of the run."""
    chunks_before = span.chunk
    for reader in readers:
        entries = reader.tick_chunks[chunks_before:]
        chunks_before = max(chunks_before - len(reader.tick_chunks), 0)
        for rows in reader.blocks(None, entries, ahead=False):
            ticks = rows[:, signals.TICK]
            begin = int((ticks < span.first_tick).sum())
            end = len(rows) if span.last_tick is None else int((ticks <= span.last_tick).sum())
            if begin < end:
                yield rows[begin:end]
            if end < len(rows):
                return

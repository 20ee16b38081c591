"""The recorder's buffers of ticks, their statistics, waiting messages and segments, filled with hand-made rows."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from rtloop.recording.capture.buffer import TickBuffer
from rtloop.recording.capture.decimation import Decimation
from rtloop.recording.capture.pending import PendingEntry, count_pending
from rtloop.recording.capture.rings import RingReader
from rtloop.recording.capture.segment_buffer import SegmentBuffer
from rtloop.recording.file.event_window import OVERVIEW_BATCH_S, EventWindow
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.contents import Message
from rtloop.recording.file.topics.overview import are_plausible
from rtloop.signals import DEADLINE, PERIODS_MISSED, TICK, Mode
from tests.recording.hand_made_loop import COLUMNS, RATE_HZ, HandMadeLoop, make_rows

PERIOD_NS = 100_000


class FullRing:
    """Stand-in for a RingReader that gives all its rows at once."""

    def __init__(self, rows: np.ndarray) -> None:
        self._rows = rows

    def take_into(self, out: np.ndarray) -> tuple[int, int]:
        """Copy all rows to the front of `out`. Returns (count, 0 lost)."""
        out[: len(self._rows)] = self._rows
        return len(self._rows), 0


def make_buffer(rows: np.ndarray) -> TickBuffer:
    """Return a buffer that holds the rows."""
    buffer = TickBuffer(list(COLUMNS), RATE_HZ)
    assert buffer.take_from(cast(RingReader, FullRing(rows))) == len(rows)
    return buffer


def test_ticks_behind_dropped_rows_are_due_by_the_last_of_these() -> None:
    """The clock was set forward between the two rows: a deadline computed from the first row would be 7 ms early."""
    rows = make_rows(2, first=40)
    rows[:, DEADLINE] = 4_000_000, 11_100_000
    buffer = make_buffer(rows)
    assert (len(buffer), buffer.end, buffer.count_before(41)) == (2, 42, 1)
    assert buffer.tick_time(40).time_ns == 4_000_000
    assert buffer.tick_time(44) == (44, 11_100_000 + 3 * PERIOD_NS)
    buffer.drop(2)
    assert len(buffer) == 0
    assert buffer.tick_time(44) == (44, 11_100_000 + 3 * PERIOD_NS)


def test_a_missing_tick_ends_an_interval_and_no_other_does() -> None:
    rows = make_rows(25)[[*range(7), *range(8, 25)]]
    decimation = Decimation(rows.shape[1], 10)
    decimation.add_rows(rows[:3])
    decimation.add_rows(rows[3:])
    assert decimation.pending_count == 3
    assert decimation.first_tick == 0
    intervals = decimation.take_intervals(10)
    assert intervals[:, TICK, :2].tolist() == [[0, 6], [8, 17], [18, 24]]
    for interval, part in zip(intervals, (rows[:7], rows[7:17], rows[17:]), strict=True):
        np.testing.assert_array_equal(interval[:, 0], part.min(axis=0))
        np.testing.assert_array_equal(interval[:, 1], part.max(axis=0))
        np.testing.assert_allclose(interval[:, 2], part.mean(axis=0), rtol=1e-12, atol=1e-12)


def make_intervals(*ranges: tuple[float, float], column: int = TICK) -> np.ndarray:
    """Return plausible statistics (ranges, columns, 3), with `ranges` as the extremes of `column`."""
    intervals = np.zeros((len(ranges), len(COLUMNS), 3))
    for growing_column in (TICK, DEADLINE):
        intervals[:, growing_column, 0] = 100 * np.arange(len(ranges))
        intervals[:, growing_column, 1] = intervals[:, growing_column, 0] + 99
    intervals[:, column, :2] = ranges
    return intervals


@pytest.mark.parametrize("column", [TICK, DEADLINE])
@pytest.mark.parametrize(
    ("ranges", "plausible"),
    [
        (((0, 9), (10, 19), (40, 49)), (True, True, True)),
        (((0, 9), (9, 19), (40, 49)), (True, False, True)),
        (((0, 49), (50, 40), (60, 69)), (True, False, True)),
        (((-1, 9), (10, 19.5), (40, 49)), (False, False, True)),
        (((0, 9), (10, np.nan), (40.5, 49)), (True, False, False)),
        (((0, 9), (10, 1e300), (np.inf, np.inf)), (True, False, False)),
    ],
)
def test_intervals_must_have_whole_ticks_and_times_in_order(ranges, plausible, column: int) -> None:
    assert tuple(are_plausible(make_intervals(*ranges, column=column))) == plausible


def entry(channel: int, *, tick: int = 0, from_loop: bool = False) -> PendingEntry:
    """Return a pending message of a channel, at a tick."""
    return PendingEntry(tick, Message(channel, tick * PERIOD_NS, b"{}"), from_loop)


def test_a_reader_of_a_ring_counts_the_slots_of_all_its_losses() -> None:
    loop = HandMadeLoop()
    reader, slots = RingReader(loop.block, "events"), len(loop.block.ring("events").slots)
    for lost in (7, 12):
        for tick in range(slots + lost - reader.lost):
            loop.command(tick, Mode.OFF)
        assert len(reader.take()) == slots
        assert reader.lost == lost


def test_events_of_the_recorder_are_not_counted_as_waiting_and_snapshots_are() -> None:
    entries = [entry(format.EVENTS, from_loop=True), entry(format.EVENTS), entry(format.LAW), entry(format.LAW)]
    assert count_pending(entries, format.EVENTS) == 1
    assert count_pending(entries, format.LAW) == 2


def test_rows_put_back_into_an_empty_buffer_are_followed_by_the_next_ones_of_their_segment() -> None:
    """A batch of all rows could not be written. A snapshot for the next tick then begins no separate segment."""
    rows = make_rows(300)
    buffer = SegmentBuffer(EventWindow(0.0, 0.0, ("trip",), 0.01), list(COLUMNS), RATE_HZ, 0, -1)
    buffer.add([], rows[:100])
    batch = buffer.next_batch(lambda tick: False, decide_all=True)
    assert batch is not None
    assert buffer.next_batch(lambda tick: False, decide_all=True) is None
    buffer.requeue(batch)
    assert buffer.first_waiting_tick == 0
    buffer.begin_segment(100)
    buffer.add([], rows[100:200])
    taken_rows = []
    while (batch := buffer.next_batch(lambda tick: False, decide_all=True)) is not None:
        assert not len(batch.intervals)
        taken_rows.append(batch.rows)
    assert np.concatenate(taken_rows).tobytes() == rows[:200].tobytes()


def test_ticks_are_retained_after_the_last_of_several_hits() -> None:
    """One condition holds from tick 0 to tick 250, another one at tick 100 alone."""
    rows = make_rows(500)
    rows[:, PERIODS_MISSED] = 0.0
    rows[100, PERIODS_MISSED], rows[[0, 250], -1] = 1.0, 1e3
    window = EventWindow(0.0, 0.01, (f"{COLUMNS[-1]} > 900", "late"), 0.01)
    buffer = SegmentBuffer(window, list(COLUMNS), RATE_HZ, 0, -1)
    for first, end in ((0, 300), (300, 400), (400, 500)):
        buffer.begin_segment(first)
        buffer.find_hits([], rows[first:end])
        buffer.add([], rows[first:end])
    taken_rows = [batch.rows for batch in iter(lambda: buffer.next_batch(lambda _: False, decide_all=True), None)]
    assert np.concatenate(taken_rows).tobytes() == rows[:400].tobytes()


def test_each_overview_waits_for_as_many_ticks_as_the_first() -> None:
    rate_hz, snapshot_ticks, every_ticks = 100.0, 100, 10
    batch_ticks = round(OVERVIEW_BATCH_S * rate_hz)
    rows = make_rows(snapshot_ticks + 3 * batch_ticks)
    buffer, sizes = SegmentBuffer(EventWindow(0.0, 0.0, ("trip",), 0.1), list(COLUMNS), rate_hz, 0, -1), []
    for first in range(0, len(rows), snapshot_ticks):
        buffer.begin_segment(first)
        buffer.add([], rows[first : first + snapshot_ticks])
        while (batch := buffer.next_batch(lambda _: False)) is not None:
            sizes += [len(batch.intervals) * every_ticks] if len(batch.intervals) else []
    assert sizes == [batch_ticks] * 2

"""The reader delivers whole records once and in order, counts lost ones, follows a restarted service, and never writes.

The expected records are those of a ring that the test fills, and those of the recording of a real service.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rtloop import load
from rtloop.client.ticks.block_mapping import open_mapping
from rtloop.client.ticks.reader import MAX_TICKS, Reader
from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.engine.memory import SharedBlock, Sizes
from rtloop.engine.ring import claim, publish
from rtloop.errors import HostRefusal, UnavailableError
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for

COLUMNS = ("tick", "deadline_ns", "x_position_um")


class LoopBlock:
    """Shared block of a loop at `path`, in place of an earlier one; the test writes its ticks as a loop does."""

    def __init__(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        self.tick = 0

    def begin(self) -> None:
        """Create the block's contents with an empty ring of ticks."""
        block = SharedBlock.create(Sizes(len(COLUMNS), 1, 400.0, 64, 1), self._fd)
        self.ring, self.events = block.ring("ticks"), block.ring("events")

    def run(self, ticks: int) -> None:
        """Publish the records of the next `ticks` ticks; the position of tick n is −n µm."""
        for tick in range(self.tick, self.tick + ticks):
            self.ring.slots[claim(self.ring, np.uint64(tick))] = tick, tick * 2.5e6, -tick
            publish(self.ring, np.uint64(tick))
        self.tick += ticks

    def report(self, *ticks: int) -> None:
        """Publish an event at each of these ticks."""
        for tick in ticks:
            position = self.events.head[0]
            self.events.slots[claim(self.events, position)]["tick"] = tick
            publish(self.events, position)

    def close(self) -> None:
        os.close(self._fd)


@pytest.fixture
def make_block(tmp_path: Path) -> Iterator[Callable[[], LoopBlock]]:
    """Yield a function that replaces the block by the block of a new loop; all blocks are closed at the end."""
    blocks = []

    def make() -> LoopBlock:
        blocks.append(LoopBlock(tmp_path / "lab.block"))
        return blocks[-1]

    yield make
    for block in blocks:
        block.close()


@pytest.fixture
def reader(tmp_path: Path) -> Reader:
    """Return a reader of the block, which need not exist yet."""
    return Reader(tmp_path / "lab.block", lambda: COLUMNS)


def span(stretch: Stretch | None) -> tuple[int, int, int, int]:
    """Return (first, end, lost, run) of a stretch after checking the values of its rows."""
    assert stretch is not None
    ticks = np.arange(stretch.first, stretch.end, dtype=float)
    np.testing.assert_array_equal(stretch["tick"], ticks)
    np.testing.assert_array_equal(stretch["x_position_um"], -ticks)
    np.testing.assert_array_equal(stretch.periods(400.0), ticks)
    return stretch.first, stretch.end, stretch.lost, stretch.run


def test_the_reader_reads_each_tick_once_and_changes_to_another_run(
    reader: Reader, make_block: Callable[[], LoopBlock]
):
    assert reader.read() is None
    loop = make_block()
    assert reader.read() is None  # The file is still empty.
    loop.begin()
    assert reader.read() is None
    loop.run(10)
    loop.report(3, 7)
    assert span(reader.read()) == (0, 10, 0, 0)
    assert reader.read() is None
    assert reader.read_messages()["tick"].tolist() == [3, 7]
    loop.run(5)
    new_loop = make_block()
    new_loop.begin()
    assert span(reader.read()) == (10, 15, 0, 0)
    assert reader.read() is None
    assert reader.run == 1
    new_loop.run(3)
    new_loop.report(0, 1, 2)
    assert span(reader.read()) == (0, 3, 0, 1)
    assert reader.read_messages()["tick"].tolist() == [0, 1, 2]
    assert reader.lost_ticks == 0


def test_overwritten_ticks_are_counted_as_lost(reader: Reader, make_block: Callable[[], LoopBlock]):
    """Reading starts near the oldest tick of a full ring, without a loss; ticks overwritten afterwards are lost."""
    loop = make_block()
    loop.begin()
    capacity = len(loop.ring.slots)
    loop.run(2 * capacity)
    first, end, lost, _ = span(reader.read())
    assert (end, lost) == (2 * capacity, 0)
    assert capacity < first < 1.1 * capacity
    loop.run(capacity + 7)
    assert span(reader.read()) == (2 * capacity + 7, 3 * capacity + 7, 7, 0)
    assert reader.lost_ticks == 7
    assert capacity < MAX_TICKS


def test_the_mapping_is_read_only(tmp_path: Path, make_block: Callable[[], LoopBlock]):
    make_block().begin()
    mapping = open_mapping(tmp_path / "lab.block")
    assert mapping is not None
    assert not any(array.flags.writeable for array in mapping.tick_ring())
    for line in Path("/proc/self/maps").read_text().splitlines():
        if line.endswith("lab.block") and line.split()[1] == "r--s":
            break
    else:
        raise AssertionError("the block is not mapped read-only")
    with pytest.raises(ValueError, match="cannot set WRITEABLE"):
        mapping.tick_ring().head.setflags(write=True)


def test_wrong_names_and_a_block_that_others_may_write_are_refused(
    tmp_path: Path, reader: Reader, make_block: Callable[[], LoopBlock]
):
    make_block().begin()
    with pytest.raises(UnavailableError, match="ticks have 3 signals, but the service names 2"):
        Reader(tmp_path / "lab.block", lambda: COLUMNS[:2]).read()
    (tmp_path / "lab.block").chmod(0o666)
    with pytest.raises(HostRefusal, match="other users may write to this file"):
        reader.read()


@pytest.mark.system
def test_ticks_from_the_reader_equal_the_recording(tmp_path: Path):
    """The ticks are compared byte by byte, from the first second to the end; the reader does not own the block."""
    with Bench(tmp_path) as bench:
        recorded_file = next((tmp_path / "recordings").glob("*.mcap*"))
        wait_for(lambda: recorded_file.exists() and recorded_file.stat().st_size, "a recording")
        reader = Reader(tmp_path / "run" / "lab.block", lambda: load(recorded_file).columns)
        parts = [wait_for(reader.read, "ticks")]

        def read_on() -> int:
            """Read the next ticks into `parts`; return the tick after the last one."""
            if (stretch := reader.read()) is not None:
                parts.append(stretch)
            return parts[-1].end

        wait_for(lambda: read_on() > parts[0].end + 4000, "a second more")
        assert bench.blocks[-1].driver_pid() == bench.pid("rt")
        bench.stop()
        while (stretch := reader.read()) is not None:
            parts.append(stretch)
    recording = load(next((tmp_path / "recordings").glob("*.mcap")))
    rows = np.concatenate([part.rows for part in parts])
    assert [part.first for part in parts[1:]] == [part.end for part in parts[:-1]]
    assert reader.lost_ticks == 0
    recorded = np.column_stack(recording.read(*recording.columns))
    assert recorded[-1, 0] == rows[-1, 0]
    assert rows.tobytes() == recorded[int(rows[0, 0]) :].tobytes()

"""Several threads pack ticks into the same bytes as one thread, chunk by chunk."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from rtloop.recording.capture import session
from rtloop.recording.file import tick_packer
from rtloop.recording.file.reader import Reader
from rtloop.recording.file.tick_packer import TickPacker
from rtloop.recording.file.topics.format import LAW, TICKS
from rtloop.recording.file.writer import Writer
from rtloop.signals import DEADLINE
from tests.recording.hand_made_loop import COLUMNS, START_UNIX_NS, make_header, make_rows
from tests.recording.real_loop import eventful_configuration, record

CHUNKS = 7


@pytest.mark.parametrize("message_index", [False, True])
@pytest.mark.parametrize("workers", [2, 5])
def test_several_threads_pack_the_bytes_of_one(workers: int, message_index: bool):
    single, several = (TickPacker(COLUMNS, message_index=message_index, workers=n) for n in (1, workers))
    rows = make_rows(CHUNKS * single.chunk_rows - 100)
    parts = np.array_split(rows, np.arange(1, CHUNKS) * single.chunk_rows)
    by_one = chain.from_iterable(single.pack(part, START_UNIX_NS) for part in parts)
    by_several = list(several.pack(rows, START_UNIX_NS))
    assert by_several == list(by_one)
    assert [chunk.counts for chunk in by_several] == [{TICKS: len(part)} for part in parts]
    assert [bool(chunk.indexes) for chunk in by_several] == [message_index] * CHUNKS


def test_a_run_in_virtual_time_has_the_same_bytes_for_any_threads_chunks_that_wait_and_pace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The chunks of ticks are compared; the first chunk holds the time of the run."""
    files = []
    for workers, chunks, flush_s in ((1, 1, 0.4), (1, 8, 0.4), (2, 8, -1.0), (4, 3, 0.4)):
        monkeypatch.setattr(tick_packer, "_default_workers", lambda count=workers: count)
        monkeypatch.setattr(session, "UNPACED_CHUNKS", chunks)
        monkeypatch.setattr(session, "FLUSH_S", flush_s)
        (path,) = record(tmp_path / f"{workers}-{chunks}.mcap", eventful_configuration(), 60_000)
        files.append(tick_chunk_records(path))
    assert len(files[0]) == 15
    assert all(file == files[0] for file in files)


def test_a_snapshot_stands_before_the_chunk_of_its_tick_and_behind_the_chunk_before(tmp_path: Path):
    (path,) = record(tmp_path / "run.mcap", eventful_configuration(), 60_000)
    end_ns, snapshots_ns, pending_ns = -1.0, [], []
    with Reader(path) as reader:
        for rows, messages in reader.chunks():
            pending_ns += [message.log_time for message in messages if message.channel == LAW]
            if rows is not None:
                assert all(end_ns < time_ns <= rows[-1, DEADLINE] for time_ns in pending_ns)
                end_ns, snapshots_ns, pending_ns = rows[-1, DEADLINE], snapshots_ns + pending_ns, []
    assert snapshots_ns == [second * 1_000_000_000 for second in range(6)]


def tick_chunk_records(path: Path) -> list[bytes]:
    """Return the bytes of each chunk record of ticks; the index lists no channel for these chunks."""
    data = path.read_bytes()
    with Reader(path) as reader:
        places = [entry.index for entry in reader.entries if entry.index and not entry.index.channels]
        return [data[place.offset : place.offset + place.length] for place in places]


def test_ticks_that_were_packed_and_not_written_are_not_written_later(tmp_path: Path):
    """A write that fails ends the block early; other ticks follow."""
    writer = Writer(tmp_path / "run.mcap", make_header(), START_UNIX_NS)
    count = TickPacker(COLUMNS).chunk_rows
    rows = make_rows(4 * count)
    with writer.packing(rows[: 3 * count]):
        writer.write([], rows[:count])
    writer.write([], rows[3 * count :])
    writer.close()
    with Reader(writer.part, tolerant=True) as reader:
        ticks = np.concatenate([block[:, 0] for block in reader.blocks()])
    assert ticks.tolist() == [*range(count), *range(3 * count, 4 * count)]

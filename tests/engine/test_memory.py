"""The shared block: all mappings of its file show the same arrays; an unpickled plan equals the original."""

from __future__ import annotations

import os
import pickle
from itertools import pairwise

import numpy as np
import pytest

from rtloop.engine.memory import RING_SECONDS, SharedBlock, Sizes, Word, ring_ticks
from tests.engine.harness import AXIS, CONTROLLER, IDEAL, MATCHED, LoopBench, make_plan, text

SIZES = Sizes(columns=21, axes=1, rate_hz=10_000, snapshot_bytes=1000, table_samples=7)


def test_a_second_mapping_sees_what_the_first_writes():
    block = SharedBlock.create(SIZES)
    second = SharedBlock(os.dup(block.fd))
    block.store(Word.STOP, 3)
    block["last_drive_v"][0] = -2.5
    block.ring("ticks").slots[-1, -1] = 7.0
    block["commands"]["values"][255, 11] = 1.5
    assert second.load(Word.STOP) == 3
    assert second["last_drive_v"].tolist() == [-2.5]
    assert second.ring("ticks").slots[-1, -1] == 7.0
    assert second["commands"]["values"][255, 11] == 1.5


def test_a_block_in_a_file_outlives_its_maker(tmp_path):
    path = tmp_path / "block"
    block = SharedBlock.create(SIZES, os.open(path, os.O_RDWR | os.O_CREAT, 0o600))
    block["last_drive_v"][0] = 4.0
    del block
    reopened = SharedBlock(os.open(path, os.O_RDWR))
    assert reopened["last_drive_v"].tolist() == [4.0]


def test_arrays_do_not_overlap():
    block = SharedBlock.create(SIZES)
    names = ["words", "last_drive_v", "table", "commands"]
    names += [f"{ring}_{part}" for ring in ("ticks", "events", "snapshots") for part in ("head", "marks", "slots")]
    spans = sorted((block[name].ctypes.data, block[name].ctypes.data + block[name].nbytes) for name in names)
    assert all(end <= start for (_, end), (start, _) in pairwise(spans))
    assert all(start % 64 == 0 for start, _ in spans)


@pytest.mark.parametrize("rate_hz", [1.0, 1000.0, 10_000.0, 44_100.0, 1e6])
def test_the_ring_holds_its_seconds(rate_hz):
    slots = ring_ticks(rate_hz)
    assert slots >= RING_SECONDS * rate_hz
    assert slots & (slots - 1) == 0


def test_a_plan_survives_pickling():
    plan = make_plan(text(IDEAL, AXIS, CONTROLLER, MATCHED))
    unpickled = pickle.loads(pickle.dumps(plan))
    assert unpickled.columns == plan.columns
    first, second = LoopBench(plan).run(500), LoopBench(unpickled).run(500)
    assert first.tobytes() == second.tobytes()
    assert np.array_equal(unpickled.coefficients, plan.coefficients)


def test_a_shorter_fault_leaves_nothing_of_the_one_before():
    block = SharedBlock.create_private(Sizes(4, 1, 1000.0, 8, 1))
    for message in ("the driver lost its device", "µ", ""):
        block.fault = message
        assert block.fault == (message or None)

"""Samples that a board drops or repeats: their number follows from the seed, and none reaches the controller.

The oracle is a second xorshift64 generator with the same seed.
"""

from __future__ import annotations

import hashlib
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from rtloop.hil.board import DROPPED, REPEATED, BoardMemory, serve
from rtloop.hil.options import BoardOptions
from tests.drivers.processes import board_memory
from tests.hil.xorshift import xorshift64

RATE_HZ = 20_000.0
SLICES = 3


def run_board(path: Path, **options: float) -> tuple[int, BoardMemory]:
    """Run a board for SLICES slices; return its number of samples and its memory."""
    ends = iter([False] * SLICES)
    samples = serve(path, BoardOptions.model_validate(options), ["x"], RATE_HZ, lambda: next(ends, True))
    return samples, board_memory(path)


def random_shares(seed: int, count: int) -> np.ndarray:
    """Return the first `count` states of xorshift64 as numbers from 0 to 1."""
    first = int.from_bytes(hashlib.sha256(f"{seed}/losses".encode()).digest()[:8], "little")
    return np.array([(word >> 11) / 2**53 for word in islice(xorshift64(first), count)])


@pytest.mark.parametrize("seed", [0, 7])
def test_losses_are_determined_by_the_seed(tmp_path, seed):
    samples, memory = run_board(tmp_path / "board", dropped_share=0.1, repeated_share=0.05, seed=seed)
    drawn = random_shares(seed, samples)
    assert samples == SLICES * RATE_HZ * 0.02
    assert memory.words[DROPPED] == np.sum(drawn < 0.1) > 0
    assert memory.words[REPEATED] == np.sum((drawn >= 0.1) & (drawn < 0.1 + 0.05)) > 0
    assert abs(np.mean(drawn < 0.1) - 0.1) < 5 * np.sqrt(0.1 * 0.9 / samples)


@pytest.mark.parametrize(
    ("options", "value", "time"),
    [({}, True, True), ({"dropped_share": 1.0}, False, False), ({"repeated_share": 1.0}, False, True)],
)
def test_lost_values_and_times_do_not_reach_the_controller(tmp_path, options, value, time):
    """The sensor has an offset: a delivered value is not 0, while untouched memory holds zeros."""
    plant = {"sensor": {"offset_um": 20.0, "um_per_v": 10.0}}
    samples, memory = run_board(tmp_path / "board", plant=plant, **options)  # type: ignore[arg-type]
    assert samples
    assert (memory.adc_codes[0] != 0) == value
    assert (memory.sample_ns[0] != 0) == time


def test_shares_above_1_in_sum_are_refused():
    with pytest.raises(
        ValidationError, match=r"dropped_share 0\.6 and repeated_share 0\.5; allowed: a sum of at most 1"
    ):
        BoardOptions(dropped_share=0.6, repeated_share=0.5)

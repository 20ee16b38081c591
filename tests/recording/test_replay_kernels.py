"""The compiled passes of a replay against numpy: the first value that differs, and the tape of inputs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rtloop.recording.replay.kernels import fill_tape, first_unequal
from rtloop.signals import DEADLINE, FLAGS, LATENESS, PERIODS_MISSED, TICK, Flag

MEASURED = [2, 3, 4, 5, 6]
COLUMNS = 21
NUMBERS = np.array([0.0, -0.0, 1.0, -1.0, np.nan, -np.nan, np.inf, 5e-324, 1e300])


def random_rows(random: np.random.Generator, count: int) -> np.ndarray:
    """Return rows (count, COLUMNS) of NUMBERS, with whole numbers as flags."""
    rows = random.choice(NUMBERS, (count, COLUMNS))
    rows[:, FLAGS] = random.integers(0, 2**20, count)
    return rows


def expected_differences(recorded: np.ndarray, replayed: np.ndarray) -> np.ndarray:
    """Return (rows, columns) of bool: the values that differ; flags as whole numbers without the bit OVERRUN."""
    unequal = recorded.view(np.uint64) != replayed.view(np.uint64)
    unequal[:, MEASURED] = False
    masks = [rows[:, FLAGS].astype(np.int64) & ~int(Flag.OVERRUN) for rows in (recorded, replayed)]
    odd = np.signbit(recorded[:, FLAGS]) | (recorded[:, FLAGS] != np.rint(recorded[:, FLAGS]))
    unequal[:, FLAGS] &= (masks[0] != masks[1]) | odd
    return unequal


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("seed", range(40))
def test_the_first_value_that_differs_is_found(seed: int, order: Any) -> None:
    random = np.random.default_rng(seed)
    count = int(random.integers(1, 60))
    recorded = random_rows(random, count)
    replayed = np.vstack([recorded, random_rows(random, 2)])
    replayed[:count, MEASURED] = 7.0
    replayed[:count, FLAGS] = (recorded[:, FLAGS].astype(np.int64) ^ random.choice([0, int(Flag.OVERRUN)], count)) * 1.0
    for _ in range(int(random.integers(0, 4))):
        row, column = random.integers(0, count), random.integers(0, COLUMNS)
        replayed[row, column] = random.choice(NUMBERS) if column != FLAGS else replayed[row, column] + 2.0
    expected = expected_differences(recorded, replayed[:count])
    difference = first_unequal(np.array(recorded, order=order), replayed)
    if not expected.any():
        assert difference is None
        return
    row = int(np.argmax(expected.any(axis=1)))
    assert difference == (row, int(np.argmax(expected[row])))


@pytest.mark.parametrize("number", [-0.0, 0.5])
def test_recorded_flags_that_are_no_number_of_flags_differ(number: float) -> None:
    recorded, replayed = np.zeros((1, COLUMNS)), np.zeros((1, COLUMNS))
    recorded[0, FLAGS] = number
    assert first_unequal(recorded, replayed) == (0, FLAGS)


def test_arrays_that_do_not_fit_are_refused() -> None:
    rows = np.zeros((3, COLUMNS))
    assert first_unequal(rows[:0], rows[:0]) is None
    for misfit in (rows[:2], rows[:, :5]):
        with pytest.raises(ValueError, match="at least 3 rows of 21 values"):
            first_unequal(rows, misfit)
    with pytest.raises(ValueError, match="allowed: float64, steps of 0, 8, 16, … bytes"):
        first_unequal(rows, rows.astype(np.float32))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="allowed: float64, steps of 0, 8, 16, … bytes"):
        first_unequal(rows[::-1], rows)
    pairs, tape, refused = np.array([[4, 9]]), np.zeros((3, 6)), np.zeros(3, np.bool_)
    for wrong in (np.array([[6, 9]]), np.array([[4, COLUMNS]]), np.array([[-1, 9]])):
        with pytest.raises(ValueError, match="pairs of existing columns"):
            fill_tape(rows, wrong, tape, refused)
    with pytest.raises(ValueError, match="a row and a flag for each tick"):
        fill_tape(rows, pairs, tape[:2], refused)
    with pytest.raises(ValueError, match="a row and a flag for each tick"):
        fill_tape(rows, pairs, tape, refused[:2])


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("seed", range(5))
def test_a_tape_holds_the_times_and_the_columns_asked_for(seed: int, order: Any) -> None:
    random = np.random.default_rng(seed)
    count = int(random.integers(1, 50))
    rows = random.normal(0, 1, (count, COLUMNS))
    rows[:, TICK], rows[:, DEADLINE] = np.arange(count), 1e5 * np.arange(count)
    rows[:, LATENESS] = random.integers(0, 10**6, count) / 1000
    rows[:, FLAGS] = random.choice([0, int(Flag.HEARTBEAT_LOST), int(Flag.WRITE_FAILED), 1 << 19], count)
    pairs = np.array([[4, 10], [5, 13], [6, 12], [8, 20]])
    tape, refused = np.full((64, 9), 3.5), np.zeros(64, np.bool_)
    fill_tape(np.array(rows, order=order), pairs, tape, refused)
    flags = rows[:, FLAGS].astype(np.int64)
    np.testing.assert_array_equal(tape[:count, 0], rows[:, DEADLINE])
    np.testing.assert_array_equal(tape[:count, 1], rows[:, DEADLINE] + np.rint(rows[:, LATENESS] * 1e3))
    np.testing.assert_array_equal(tape[:count, 2], rows[:, PERIODS_MISSED])
    np.testing.assert_array_equal(tape[:count, 3], np.where(flags & int(Flag.HEARTBEAT_LOST), np.inf, np.nan))
    np.testing.assert_array_equal(tape[:count, pairs[:, 0]], rows[:, pairs[:, 1]])
    np.testing.assert_array_equal(refused[:count], flags & int(Flag.WRITE_FAILED) != 0)
    assert np.all(tape[count:] == 3.5)
    assert np.all(tape[:, 7] == 3.5)
    assert not refused[count:].any()

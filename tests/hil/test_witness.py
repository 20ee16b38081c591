"""A board's evidence about its outputs, compared with a computation from all pairs of voltages and times.

All times are simulated, without process and clock. The board does not know the true times of the writes.
"""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.hil.board import (
    EXAMINED,
    FIFO,
    LOOKED_NS,
    LSB_V,
    MAX_CHANNELS,
    MISSED_WRITES,
    WORDS,
    WRITE,
    WRITTEN,
    _record_position,
    examine_writes,
)
from rtloop.hil.witness import EVIDENCE, LEVEL, MAX_LEVELS, judge_write

WINDOW_NS, BEGIN_NS = 1_000_000, 10**12


class Card:
    """A card's memory, and a board that looks at it at given times."""

    def __init__(self) -> None:
        self.words = np.zeros(WORDS, np.uint64)
        self.fifo = np.zeros(FIFO, WRITE).view(np.recarray)
        self.records = np.zeros(MAX_CHANNELS, EVIDENCE).view(np.recarray)
        self.levels = np.zeros((MAX_CHANNELS, MAX_LEVELS), LEVEL).view(np.recarray)

    def write(self, code: int, stated_ns: int) -> None:
        """Write a code with the time that the controller states."""
        number = int(self.words[WRITTEN])
        self.fifo[number % FIFO].ns, self.fifo[number % FIFO].codes[0] = stated_ns, code
        self.words[WRITTEN] += np.uint64(1)

    def look(self, now_ns: int) -> None:
        """Let the board examine the writes at a time."""
        examine_writes(self.words, self.fifo, self.records, self.levels, 1, self.words[WRITTEN], now_ns, True)
        self.words[LOOKED_NS] = now_ns

    def run(self, codes: np.ndarray, true_ns: np.ndarray, look_ns: np.ndarray, stated_ns: np.ndarray) -> None:
        """Make all writes and looks in the order of their true times, then a last look."""
        written = 0
        for now_ns in (*look_ns, max(true_ns[-1], look_ns[-1]) + 1):
            while written < len(codes) and true_ns[written] < now_ns:
                self.write(codes[written], stated_ns[written])
                written += 1
            self.look(int(now_ns))

    @property
    def evidence(self) -> tuple[float, float, float, float]:
        """Largest step, largest change within a window, lowest and highest voltage, all in V."""
        record = self.records[0]
        return record.largest_step_v, record.largest_window_v, record.lowest_v, record.highest_v


def compare_all_pairs(written_v: np.ndarray, true_ns: np.ndarray) -> tuple[float, float, float, float]:
    """Return the evidence by definition: 0 V, then each voltage until the next; all pairs at most a window apart."""
    changes = np.flatnonzero(np.diff(written_v, prepend=0.0) != 0)  # equal voltages in a row are one voltage
    volts = np.concatenate([[0.0], written_v[changes]])
    begin_ns, end_ns = np.concatenate([[0], true_ns[changes]]), np.concatenate([true_ns[changes], [2**62]])
    apart_ns = begin_ns[None, :] - end_ns[:, None]  # from the end of the earlier voltage to the begin of the later
    joined = np.triu(np.ones((len(volts), len(volts)), bool), 1) & (apart_ns <= WINDOW_NS)
    change_v = np.abs(volts[None, :] - volts[:, None])
    return np.max(np.abs(np.diff(volts))), np.max(change_v[joined]), volts.min(), volts.max()


def draw_writes(chance: np.random.Generator, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Return random codes and times: ramps, noise and jumps, in bursts and after pauses, one in ten without change."""
    kinds = chance.integers(0, 3, count)
    noise, jumps = chance.integers(-40, 41, count), chance.integers(-9000, 9001, count)
    change = np.choose(kinds, [noise, np.full(count, -300), jumps])
    change[chance.random(count) < 0.1] = 0
    codes = np.clip(np.cumsum(change), -32768, 32767)
    gaps_ns = np.choose(chance.integers(0, 3, count),
                        [chance.integers(1, 3000, count), chance.integers(50_000, 500_000, count),
                         chance.integers(900_000, 1_100_000, count)])  # fmt: skip
    return codes, BEGIN_NS + np.cumsum(gaps_ns)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("look_period_ns", [125_000, 3_000_000, 50_000_000, 10**12])
def test_steps_and_windows_are_right_however_rarely_the_board_looks(seed, look_period_ns):
    chance = np.random.default_rng(seed)
    codes, true_ns = draw_writes(chance)
    look_ns = np.arange(BEGIN_NS, true_ns[-1] + 2 * look_period_ns, look_period_ns)
    card = Card()
    card.run(codes, true_ns, look_ns, true_ns)
    assert card.evidence == compare_all_pairs(codes * LSB_V, true_ns)
    assert card.words[MISSED_WRITES] == 0
    assert card.words[EXAMINED] == len(codes)
    assert card.records[0].moved_ns == true_ns[np.flatnonzero(np.diff(codes))[-1] + 1]


def test_a_controller_cannot_spread_its_writes_over_time_by_their_dates():
    """Sixteen steps within 16 µs, dated a millisecond apart, before or after the truth: each look bounds the dates."""
    codes, true_ns = -300 * np.arange(1, 17), BEGIN_NS + 1000 * np.arange(16)
    for dates_ns in (BEGIN_NS + 2_000_000 * np.arange(16), BEGIN_NS - 2_000_000 * np.arange(16)[::-1], 0 * true_ns):
        card = Card()
        card.run(codes, true_ns, np.arange(BEGIN_NS - 250_000, BEGIN_NS + 250_000, 125_000), dates_ns)
        assert card.evidence[1] == 16 * 300 * LSB_V


def test_a_write_delayed_after_its_date_is_not_judged_steeper():
    """Each write is dated 250 µs after the previous write; one takes effect 2 ms after its date."""
    period_ns, delay_ns = 250_000, 2_000_000
    stated_ns = BEGIN_NS + period_ns * np.arange(40) + delay_ns * (np.arange(40) > 20)
    true_ns = stated_ns + 100
    true_ns[20] += delay_ns
    card = Card()
    card.run(-409 * np.arange(1, 41), true_ns, np.arange(BEGIN_NS, true_ns[-1], 125_000), stated_ns)
    assert card.evidence[1] <= 5 * 409 * LSB_V + 1e-12


@pytest.mark.parametrize(("count", "fewest", "largest"), [(MAX_LEVELS + 10, 10, 10), (FIFO + 5, 5, FIFO + 5)])
def test_writes_beyond_the_window_s_or_the_card_s_memory_are_counted_as_missed(count, fewest, largest):
    card = Card()
    for number in range(count):
        card.write(number % 2 + 1, BEGIN_NS + 2_000_000 + number)
    card.look(BEGIN_NS + 10_000_000)
    assert fewest <= card.words[MISSED_WRITES] <= largest


def test_the_writes_to_a_stuck_output_are_judged():
    card = Card()
    card.write(1000, BEGIN_NS + 5)
    examine_writes(card.words, card.fifo, card.records, card.levels, 1, card.words[WRITTEN], BEGIN_NS + 10, False)
    assert (card.records[0].last_v, card.records[0].moved_ns) == (0.0, 0)
    assert card.records[0].largest_window_v == 1000 * LSB_V


def test_the_furthest_position_counts_to_either_side():
    record, rig = np.zeros(1, EVIDENCE).view(np.recarray), np.zeros(1, [("true_position_um", float)]).view(np.recarray)
    largest = []
    for position_um in (0.5, -3.0, 2.0, -1.0, 3.5):
        rig.true_position_um = position_um
        _record_position(record[0], rig[0])
        largest.append((record[0].true_position_um, record[0].largest_position_um))
    assert largest == [(0.5, 0.5), (-3.0, 3.0), (2.0, 3.0), (-1.0, 3.0), (3.5, 3.5)]


def test_a_write_is_never_earlier_than_the_one_before():
    """Two threads of a driver give dates that cross by a few ns: a level lasts no negative time."""
    evidence, levels = np.zeros(1, EVIDENCE).view(np.recarray), np.zeros(MAX_LEVELS, LEVEL).view(np.recarray)
    for volts, date_ns in ((1.0, BEGIN_NS), (2.0, BEGIN_NS - 40), (3.0, BEGIN_NS + 10)):
        judge_write(evidence[0], levels, volts, date_ns, True)
    assert levels.from_ns[1:4].tolist() == [BEGIN_NS, BEGIN_NS, BEGIN_NS + 10]

"""Figures of the fault table: the plain card's largest step and window, overlapping stalls of the host, allowed steps.

The card's figures are compared with a search over all pairs of writes; the others with numbers worked out by hand.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tests.faults.configuration import Bounds, on_a_board
from tests.faults.host import overlapping_ns
from tests.faults.plain_card import MEMORY, CardOptions, PlainCard
from tests.hil.test_witness import compare_all_pairs


def test_a_card_in_plain_python_sees_steps_and_windows(tmp_path, monkeypatch):
    chance = np.random.default_rng(3)
    volts, true_ns = chance.uniform(-9.0, 9.0, 300), 10**12 + np.cumsum(chance.integers(20_000, 600_000, 300))
    clock = iter(true_ns)
    monkeypatch.setattr(time, "monotonic_ns", lambda: int(next(clock)))
    card = PlainCard(CardOptions(file=str(tmp_path / "card")), {}, 2000.0)
    (tmp_path / "card").write_bytes(bytes(MEMORY.itemsize))
    card.start()
    for value in volts:
        card.write([float(value)])
    monkeypatch.undo()
    names = ("largest_step_v", "largest_window_v", "lowest_v", "highest_v")
    assert tuple(card.memory[name] for name in names) == compare_all_pairs(volts, true_ns)


def test_spans_that_overlap_count_once_and_only_between_two_times():
    spans = [(0, 10), (5, 20), (30, 40), (32, 35), (90, 200)]
    assert overlapping_ns(spans, 5, 100) == 15 + 10 + 10
    assert overlapping_ns(spans, 41, 89) == 0


def test_a_configuration_allows_steps_of_its_ramp_and_one_write_held_up():
    bounds = Bounds.from_text(on_a_board(Path("/nowhere")), 0.001)
    assert (bounds.rate_hz, bounds.step_v) == (4000.0, 0.125 + 0.001)
    assert bounds.window_v == pytest.approx((4 + 2) * 0.125 + 0.001)

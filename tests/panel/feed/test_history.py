"""The history of signals holds the ticks that it received; the expected values come from a dictionary of ticks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtloop.client.capture.conditions import Edge
from rtloop.client.capture.trigger import Mode, Settings, Trigger
from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.panel.feed.history import History
from tests.client.test_trigger import COLUMNS, sweep_figures


def test_history_has_the_ticks_before_a_trigger_and_nan_for_lost_ones():
    """A sweep has its tick numbers; lost ticks, ticks before the first and future ticks are NaN in the history."""
    rows = np.zeros((200, 4))
    rows[:, 3] = np.arange(200)
    trigger = Trigger(Settings(41, Mode.NORMAL, 50.0), lambda: Edge("s", 110.0))
    history = History(["s"], 64)
    sweeps = []
    for stretch in (Stretch(COLUMNS, 0, rows[:100]), Stretch(COLUMNS, 105, rows[105:], 5)):
        history.append(stretch)
        sweeps += trigger.feed(stretch)
    assert [sweep_figures(sweep) for sweep in sweeps] == [(90, 110, 131, "trigger", 0)]
    history = History(["s"], 64)
    for stretch in (Stretch(COLUMNS, 80, rows[80:100]), Stretch(COLUMNS, 105, rows[105:140], 5)):
        history.append(stretch)
    expected = np.where((np.arange(70, 145) < 80) | (np.arange(70, 145) >= 140), np.nan, np.arange(70, 145))
    expected[(np.arange(70, 145) >= 100) & (np.arange(70, 145) < 105)] = np.nan
    np.testing.assert_array_equal(history.values_between(70, 145), [expected])


@given(st.integers(1, 40), st.lists(st.tuples(st.integers(0, 50), st.integers(0, 60)), max_size=8), st.data())
def test_a_history_holds_the_last_ticks(ticks: int, pieces: list, data: st.DataObject):
    history, received, first = History(["s"], ticks), {}, 3
    for lost, length in pieces:
        first += lost
        rows = np.arange(first, first + length, dtype=float)[:, None] * np.ones(4)
        history.append(Stretch(COLUMNS, first, rows, lost))
        received |= {tick: float(tick) for tick in range(first, first + length)}
        first += length
    begin, end = sorted(data.draw(st.tuples(st.integers(-10, 200), st.integers(-10, 200))))
    expected = [received.get(tick, np.nan) if tick >= first - ticks else np.nan for tick in range(begin, end)]
    np.testing.assert_array_equal(history.values_between(begin, end)[0], expected)


def test_nothing_old_stands_in_a_historys_gap():
    """The gap has neither older ticks of the ring in place of the lost ones, nor ticks of an earlier run."""
    history, rows = History(["s"], 20), np.ones((20, 4))
    history.append(Stretch(COLUMNS, 0, rows))
    history.append(Stretch(COLUMNS, 25, rows[:5], 5))
    np.testing.assert_array_equal(history.values_between(10, 30), [[1.0] * 10 + [np.nan] * 5 + [1.0] * 5])
    history.append(Stretch(COLUMNS, 0, rows[:5], 0, 1))
    np.testing.assert_array_equal(history.values_between(-5, 5), [[np.nan] * 5 + [1.0] * 5])


def test_a_history_without_ticks_is_refused():
    with pytest.raises(ValueError, match="history: 0 ticks"):
        History(["s"], 0)

"""Scope screens of the server: sweeps at the ticks of commands, counted sweeps, and bounded subscriptions."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtloop.client.ticks.tick_stretch import Stretch
from rtloop.panel.feed.tick_history import TickHistory
from rtloop.panel.feed.timing import Timing
from rtloop.panel.protocol.frames import pack_frame
from rtloop.panel.protocol.subscriptions import read_message, validate_field
from rtloop.panel.service.service import Description
from rtloop.panel.views.scope import Scope
from rtloop.panel.views.xy_plot import extreme_indices
from rtloop.signals import Signal, column_names
from tests.panel.web.browser import unpack_message

pytestmark = pytest.mark.system

NAMES = column_names(["x"], [])
LOOP = Description(
    "lab", 1000.0, tuple(Signal(name, "", "") for name in NAMES), Path("b"), Path("r"), {"axis": [{"name": "x"}]}
)


def make_stretch(first: int, end: int, run: int = 0, **signals: Any) -> Stretch:
    """Return ticks `first` … `end` − 1, 1 ms apart; a signal is a constant, an array by tick, or 0 by default."""
    rows = np.zeros((end - first, len(NAMES)))
    rows[:, 0], rows[:, 1] = np.arange(first, end), np.arange(first, end) * 1e6
    for name, values in signals.items():
        rows[:, NAMES.index(name)] = values[first:end] if isinstance(values, np.ndarray) else values
    return Stretch(NAMES, first, rows, 0, run)


def make_view(**trigger: Any) -> Any:
    """Return the subscription of a screen of 20 ms with these options of its trigger."""
    subscription = {"signals": ["x_reference_um"], "seconds": 0.02, "pixels": 100, "trigger": trigger}
    return validate_field("view", subscription)


def test_commands_are_found_at_their_ticks_in_stretches_of_any_length():
    random = np.random.default_rng(5)
    ticks = np.sort(random.choice(np.arange(30, 100_000, 25), 3000, replace=False))
    scope, sweeps, tick = Scope(make_view(mode="normal", kind="command", pre_percent=10), LOOP), [], 0
    while tick < 100_100:
        end = tick + int(random.integers(1, 300))
        # The events of commands come together with their ticks.
        commands = ticks[(ticks >= tick) & (ticks < end)]
        sweeps += scope.feed(make_stretch(tick, end), commands.tolist())
        tick = end
    assert [sweep.trigger for sweep in sweeps] == ticks.tolist()
    assert scope.sweep_count == 3000


def test_a_run_that_ends_shows_its_open_sweep():
    history, scope = TickHistory(NAMES, 3200), Scope(make_view(mode="normal", kind="command"), LOOP)
    first_run = make_stretch(0, 100, x_reference_um=7.0)
    history.append(first_run)
    scope.feed(first_run, [95])
    scope.end_run(history)
    second_run = make_stretch(0, 50, run=1)
    history.append(second_run)
    scope.feed(second_run, [])
    header, arrays = unpack_message(scope.frame(history))
    assert (header["run"], header["trigger"], header["end"], header["number"]) == (0, 95, 100, 1)
    assert set(arrays["x_reference_um:low"].tolist()) == {7.0}
    assert scope.frame(history) is None


def test_a_roll_and_a_long_sweep_grow():
    history = TickHistory(NAMES, 32_000)
    roll = Scope(
        validate_field("view", {"signals": ["tick"], "seconds": 1, "pixels": 50, "trigger": {"mode": "roll"}}), LOOP
    )
    trigger = {"mode": "normal", "kind": "step", "source": "x_reference_um", "pre_percent": 0}
    growing = Scope(validate_field("view", {"signals": ["tick"], "seconds": 2, "pixels": 50, "trigger": trigger}), LOOP)
    ticks = make_stretch(0, 1500, x_reference_um=(np.arange(5000) >= 1000).astype(float))
    history.append(ticks)
    growing.feed(ticks, [])
    header, arrays = unpack_message(roll.frame(history))
    assert (header["first"], header["end"], header["cause"]) == (500, 1500, "roll")
    assert arrays["tick:low"][0] == 500 + 0
    assert arrays["tick:high"][-1] == 1499
    header, arrays = unpack_message(growing.frame(history))
    assert (header["complete"], header["trigger"], header["end"]) == (False, 1000, 3000)
    assert np.nanmax(arrays["tick:high"]) == 1499
    assert growing.frame(history) is None


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("view", {"signals": ["no"], "seconds": 1, "pixels": 1e308}, "pixels"),
        ("view", {"signals": ["a"] * 9, "seconds": 1, "pixels": 10}, "signals"),
        ("view", {"signals": [], "seconds": float("nan"), "pixels": 10}, "seconds"),
        ("view", {"signals": [], "seconds": 0.0, "pixels": 10}, "seconds"),
        ("view", {"signals": [], "seconds": 1.0, "pixels": 10, "trigger": {"kind": "exec"}}, "kind"),
        ("view", {"signals": [], "seconds": 1.0, "pixels": 10, "trigger": {"level": 1e308}}, "level"),
        ("view", {"signals": [], "seconds": 1.0, "pixels": 10, "more": 1}, "more"),
        ("xy", {"axis": "x" * 101}, "axis"),
        ("hold", {"a": []}, "hold"),
        ("__class__", 1, "known"),
    ],
)
def test_invalid_subscriptions_are_refused(name: str, value: Any, words: str):
    with pytest.raises(ValueError, match=words):
        validate_field(name, value)


@pytest.mark.parametrize(
    "text", ["", "[]", "7", "{", "[" * 60_000, '{"a":' * 10_000, '{"view": NaN}', '{"\\ud800": 1}']
)
def test_invalid_messages_are_refused(text: str):
    with pytest.raises(ValueError, match=r".+"):
        read_message(text)


def test_signals_and_times_that_the_loop_lacks_are_refused():
    for change, words in (
        ({"signals": ["x_posiotn_um"]}, "not recorded; allowed"),
        ({"seconds": 61.0}, "at most 60 s"),
        ({"trigger": {"kind": "edge"}}, "source: missing"),
        ({"trigger": {"source": "y"}}, "not recorded; allowed"),
        ({"trigger": {"kind": "window", "source": "tick", "low": 2, "high": 1}}, "lower end"),
    ):
        subscription = {"signals": [], "seconds": 1.0, "pixels": 10} | change
        with pytest.raises(ValueError, match=words):
            Scope(validate_field("view", subscription), LOOP)


def test_a_frame_is_aligned():
    for length in range(9):
        data = pack_frame("x" * length, {"µ": None}, {"a": np.arange(3.0)})
        size = struct.unpack_from("<I", data)[0]
        assert (4 + size) % 8 == 0
        assert json.loads(data[4 : 4 + size])["arrays"] == [["a", 3]]
        assert np.frombuffer(data, "<f4", offset=4 + size).tolist() == [0, 1, 2]


def test_timing_covers_the_last_minute():
    random = np.random.default_rng(3)
    lateness_us = random.lognormal(2.0, 1.0, 90_000)
    lateness_us[5000], lateness_us[80_000] = 9e5, 4321.0
    timing = Timing(LOOP)
    for first in range(0, 90_000, 170):
        end = min(first + 170, 90_000)
        timing.feed(make_stretch(first, end, lateness_us=lateness_us, exec_us=10 * lateness_us))
    header, arrays = unpack_message(timing.frame())
    last_minute = lateness_us[30_000:]
    assert header["window_s"] == 60
    assert header["ticks"] == arrays["counts"].sum() == 60_000
    assert header["worst_us"] == 4321.0
    for key, quantile, factor in (("p50_us", 0.5, 1), ("p99_us", 0.99, 1), ("exec_p99_us", 0.99, 10)):
        assert header[key] == pytest.approx(factor * np.quantile(last_minute, quantile), rel=0.03)
    edges = arrays["edges_us"].astype(float)
    assert arrays["counts"][30] == pytest.approx(np.sum((last_minute >= edges[30]) & (last_minute < edges[31])), abs=1)
    assert "4321 µs late" in header["advice"][0]
    assert "rtloop doctor" in header["advice"][-1]


def test_extreme_indices_contain_all_extremes():
    random = np.random.default_rng(4)
    a, b = random.normal(size=(2, 10_007))
    indices = extreme_indices([a, b], 100)
    assert indices.size <= 400
    assert {int(np.argmin(a)), int(np.argmax(a)), int(np.argmin(b)), int(np.argmax(b))} <= set(indices.tolist())
    assert extreme_indices([a[:50]], 100).tolist() == list(range(50))

"""Each trip names its axis, value and limit, computed here from the scripted readings."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from rtloop.signals import Flag
from tests.engine.failing_driver import ScriptedDriver
from tests.engine.harness import AXIS, CONTROLLER, IDEAL, TUSTIN, LoopBench, text

INTERLOCKS = """
[axis.interlocks]
position_um = 30.0
sensor_max_v = 9.0
sample_age_us = 500.0
oscillation_um = 0.5
oscillation_swings = 6
tracking_error_um = 12.5
tracking_ticks = 40
frozen_ticks = 20
frozen_drive_v = 0.01
"""


def bench(volts: Callable[[int], float], age_us: float = 0.0) -> LoopBench:
    """Return a loop whose driver reads `volts(k)` V at read number k, from samples of age `age_us`."""
    driver = ScriptedDriver(volts)
    driver.sample_age_us = age_us
    return LoopBench(text(IDEAL, AXIS, CONTROLLER, TUSTIN, INTERLOCKS), driver)


def flicker(level: float) -> Callable[[int], float]:
    """Return scripted readings that alternate between `level` and 0.1 mV above it, so that they are not frozen."""
    return lambda k: level + 1e-4 * (k % 2)


CASES = [
    ("position", lambda k: 0.0 if k < 5 else 3.05, 0.0, 30.5, 30.0, "x: position 30.5 µm, its limit 30 µm"),
    ("position", lambda k: 0.0 if k < 5 else -3.05, 0.0, -30.5, -30.0, "x: position -30.5 µm, its limit -30 µm"),
    ("sensor_range", lambda k: 0.0 if k < 5 else 9.5, 0.0, 9.5, 9.0, "x: sensor_range 9.5 V, its limit 9 V"),
    ("stale", flicker(0.0), 700.0, 700.0, 500.0, "x: stale 700 µs, its limit 500 µs"),
    ("tracking", flicker(1.4), 0.0, -14.001, 12.5, None),
    (
        "oscillation",
        lambda k: 0.1 * (k // 4 % 2) + 1e-5 * (k % 2),
        0.0,
        6.0,
        6.0,
        "x: oscillation 6 swings, its limit 6 swings",
    ),
    ("frozen", lambda k: 0.3, 0.0, 20.0, 20.0, "x: frozen 20 ticks, its limit 20 ticks"),
    ("non_finite", lambda k: 0.0 if k < 5 else math.nan, 0.0, math.nan, 0.0, "x: non_finite nan V"),
]


@pytest.mark.parametrize(("cause", "volts", "age_us", "value", "limit", "sentence"), CASES, ids=[c[0] for c in CASES])
def test_axis_value_and_limit(
    cause: str, volts: Callable[[int], float], age_us: float, value: float, limit: float, sentence: str | None
) -> None:
    loop = bench(volts, age_us)
    loop.run(200)
    event = loop.trips()[0]
    flag = Flag[f"TRIP_{cause.upper()}"]
    assert (event["axis"], event["what"]["values"][3]) == ("x", float(flag))
    assert int(event["what"]["values"][0]) & flag
    np.testing.assert_allclose(np.array(event["what"]["values"][1:3], float), [value, limit], atol=2e-3)
    assert sentence is None or event["what"]["reason"] == sentence


def test_a_trip_names_the_axis_that_is_to_blame() -> None:
    """The second of two axes moves beyond its limit; the first rests."""
    channel = '[driver.channels.y]\ninput = "adc1"\noutput = "dac1"\num_per_v = 10.0\n'
    second = AXIS.replace('name = "x"', 'name = "y"') + "[axis.interlocks]\nposition_um = 5.0\n"
    reference = '[axis.reference]\nkind = "hold"\nvalue = 4.0\n'
    loop = LoopBench(text(channel, IDEAL, AXIS, second, reference, mode="raw"))
    loop.run(400)
    (event,) = loop.trips()
    assert (event["axis"], event["what"]["values"][2]) == ("y", 5.0)
    assert event["what"]["values"][1] > 5.0


def test_a_trip_that_is_no_axis_fault_names_none() -> None:
    loop = bench(flicker(0.0))
    loop.driver.status = -5  # type: ignore[attr-defined]
    loop.run(3)
    (event,) = loop.trips()
    assert (event["axis"], event["what"]["reason"], event["what"]["causes"]) == (None, None, ["driver"])

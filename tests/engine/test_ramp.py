"""The ramp outside the loop lasts a period for each step, at any rate."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from rtloop.drivers.base import Facts, Wiring
from rtloop.engine.ramp import ramp_to_safe, starting_outputs_v
from tests.drivers.bench_driver import WIRING, LoopBack

SLEW_V_PER_S = 1000.0


class FastLoopBack(LoopBack):
    """Loopback driver at any rate; it stores each write (V) in `rows` and its time in `written_s`."""

    def __init__(self, rate_hz: float) -> None:
        super(LoopBack, self).__init__(self.options_model(), WIRING, rate_hz)
        self.volts, self.rows = [0.0, 2.0], list[list[float]]()
        self.written_s = list[float]()

    @property
    def facts(self) -> Facts:
        return replace(super().facts, max_rate_hz=20_000.0)

    def write(self, volts) -> None:
        self.written_s.append(time.monotonic())
        self.rows.append(list(volts))
        super().write(volts)


@pytest.mark.parametrize(
    ("rate_hz", "period_s", "from_v"), [(10_000.0, 1e-4, 2.0), (1000.0, 1e-3, 5.0), (20_000.0, 1e-4, 2.0)]
)
def test_a_ramp_lasts_a_period_for_every_step(rate_hz, period_s, from_v):
    """The test has a lower bound of time, which a stall of the host only lengthens; no period is below 100 µs."""
    driver = FastLoopBack(rate_hz)
    pointers = driver.open()
    began_s = time.monotonic()
    ramp_to_safe(driver, pointers, np.array([from_v, 2.0]), SLEW_V_PER_S)
    duration_s = time.monotonic() - began_s
    steps = round(from_v / (SLEW_V_PER_S * period_s))
    rows = driver.rows[-steps:]
    assert len(driver.rows) == steps
    np.testing.assert_allclose([row[0] for row in rows], from_v * (1 - np.arange(1, steps + 1) / steps), atol=1e-12)
    assert np.diff(driver.written_s).min() >= period_s
    assert duration_s >= steps * period_s


def test_a_noted_drive_is_that_of_the_output_of_its_axis():
    """The axis has the second output. The driver reports no outputs: recorded drives count, else the safe values."""
    driver = FastLoopBack(1000.0)
    driver.wiring, driver.outputs_v = {"y": Wiring("ai1", "ao1")}, lambda: None
    assert starting_outputs_v(driver, [7.0]).tolist() == [0.0, 7.0]
    assert starting_outputs_v(driver, None).tolist() == [0.0, 2.0]

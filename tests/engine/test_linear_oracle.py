"""The whole path, from a configuration's text to the rig's true position, is the linear loop of eqs (5) and (20).

With exactly compensated hysteresis and an ideal sensor, only the linear loop remains.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.engine.harness import AXIS, CONTROLLER, EXACT, IDEAL, MATCHED, TUSTIN, LoopBench, text
from tests.engine.oracle import closed_loop

STEPS = """
[axis.reference]
kind = "steps"
levels = [0.0, 20.0, 0.0, -20.0]
dwell_s = 0.05
"""
TICKS = 4000


@pytest.mark.parametrize("latency", [0, 1])
@pytest.mark.parametrize(("method", "lines"), [("tustin", TUSTIN), ("matched", MATCHED)])
def test_steps_against_the_linear_loop(method, lines, latency):
    bench = LoopBench(text(IDEAL, AXIS, EXACT, CONTROLLER, lines, STEPS, latency=latency))
    rows = bench.run(TICKS)
    assert rows.shape[0] == TICKS
    assert not np.any(bench.column(rows, "flags"))  # no limit was active
    reference = np.array([0.0, 20.0, 0.0, -20.0])[np.arange(TICKS) // 500 % 4]
    assert np.array_equal(bench.column(rows, "x_reference_um"), reference)
    oracle = closed_loop(reference, method, latency)
    error_um = np.abs(bench.column(rows, "x_true_position_um") - oracle.position_um).max()
    assert error_um < 1e-9
    assert np.abs(bench.column(rows, "x_command_um") - oracle.command_um).max() < 1e-9
    assert np.abs(oracle.position_um).max() > 20


def test_the_oracle_can_tell():
    """The oracle with another latency or method than the loop's is far outside the tolerance."""
    bench = LoopBench(text(IDEAL, AXIS, EXACT, CONTROLLER, MATCHED, STEPS))
    position = bench.column(bench.run(1000), "x_true_position_um")
    reference = np.repeat([0.0, 20.0], 500)
    assert np.abs(position - closed_loop(reference, "matched", 1).position_um).max() > 0.1
    assert np.abs(position - closed_loop(reference, "tustin", 0).position_um).max() > 1e-3

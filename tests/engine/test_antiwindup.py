"""A 40 µm step whose command of 54 µm is limited: the controller recovers faster than one without anti-windup.

The oracle is the linear loop of `tests/engine/oracle.py`.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.engine.harness import AXIS, CONTROLLER, EXACT, IDEAL, MATCHED, TUSTIN, LoopBench, text
from tests.engine.oracle import closed_loop

STEP = '[axis.reference]\nkind = "steps"\nlevels = [0.0, 40.0]\ndwell_s = 0.4\nrepeat = false\n'
LIMITS = "[axis.limits]\ncommand_um = {}\n"
COMMAND_LIMITED, DRIVE_LIMITED = 2, 4
TICKS, REST = 3000, 4000


def simulate_step(lines: str, command_um: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the true position (µm) and the flags of each tick of a 40 µm step, with a limit of the command."""
    bench = LoopBench(text(IDEAL, AXIS, EXACT, CONTROLLER, lines, LIMITS.format(command_um), STEP))
    rows = bench.run(REST + TICKS)[REST:]
    return bench.column(rows, "x_true_position_um"), bench.column(rows, "flags").astype(int)


def overshoot_percent(position: np.ndarray) -> float:
    return 100 * (position.max() / 40 - 1)


def settling_ms(position: np.ndarray, final: float = 40.0, within: float = 0.8) -> float:
    """Return the time in ms until the position stays within `within` µm of `final`."""
    return (np.flatnonzero(np.abs(position - final) > within)[-1] + 1) / 10


@pytest.mark.parametrize(("method", "lines"), [("matched", MATCHED), ("tustin", TUSTIN)])
@pytest.mark.parametrize(
    ("command_um", "flag"), [(41.0, COMMAND_LIMITED), (80.0, DRIVE_LIMITED)], ids=["command limited", "drive limited"]
)
def test_a_limited_step_recovers(method, lines, command_um, flag):
    position, flags = simulate_step(lines, command_um)
    reference = np.full(TICKS, 40.0)
    linear = closed_loop(reference, method).position_um
    wound_up = closed_loop(reference, method, limit_um=min(command_um, 43.01835)).position_um
    assert np.any(flags & flag)
    assert not np.any(flags[500:])  # no limit is active any more
    assert overshoot_percent(position) <= overshoot_percent(linear) + 1.0
    assert overshoot_percent(position) < 0.5 * overshoot_percent(wound_up)
    assert settling_ms(position) <= 1.5 * settling_ms(linear)
    assert settling_ms(position) < settling_ms(wound_up)


@pytest.mark.parametrize(("method", "lines"), [("matched", MATCHED), ("tustin", TUSTIN)])
def test_a_reference_out_of_reach_is_left_at_once(method, lines):
    """The reference is 60 µm, beyond the limit, for 0.2 s, then 0: a controller that winds up returns much later."""
    steps = '[axis.reference]\nkind = "steps"\nlevels = [0.0, 60.0, 0.0]\ndwell_s = 0.2\nrepeat = false\n'
    bench = LoopBench(text(IDEAL, AXIS, EXACT, CONTROLLER, lines, LIMITS.format(42.0), steps))
    rows = bench.run(8000)[2000:]
    reference = np.where(np.arange(6000) < 2000, 60.0, 0.0)
    return_um = bench.column(rows, "x_true_position_um")[2000:]
    wound_up = closed_loop(reference, method, limit_um=42.0).position_um[2000:]
    settling_times_ms = [settling_ms(response, 0.0, 1.0) for response in (return_um, wound_up)]
    assert np.all(bench.column(rows, "flags")[100:2000].astype(int) & COMMAND_LIMITED)
    assert settling_times_ms[0] < 10
    assert settling_times_ms[0] < settling_times_ms[1] / 5
    assert return_um.min() > -1.5

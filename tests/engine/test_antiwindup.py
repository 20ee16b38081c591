"""A 40 µm step asks for 54 µm and is limited: the controller recovers, and better than one that does not know."""

from __future__ import annotations

import numpy as np
import pytest

from tests.engine.harness import AXIS, CONTROLLER, EXACT, IDEAL, MATCHED, TUSTIN, LoopBench, text
from tests.engine.oracle import closed_loop

STEP = '[axis.reference]\nkind = "hold"\nvalue = 40.0\n'
LIMITS = "[axis.limits]\ncommand_um = {}\n"
COMMAND_LIMITED, DRIVE_LIMITED = 2, 4
TICKS = 3000


def recorded(lines: str, command_um: float) -> tuple[np.ndarray, np.ndarray]:
    bench = LoopBench(text(IDEAL, AXIS, EXACT, CONTROLLER, lines, LIMITS.format(command_um), STEP))
    rows = bench.run(TICKS)
    return bench.column(rows, "x_true_position_um"), bench.column(rows, "flags").astype(int)


def overshoot_percent(position: np.ndarray) -> float:
    return 100 * (position.max() / 40 - 1)


def settling_ms(position: np.ndarray, final: float = 40.0, within: float = 0.8) -> float:
    """Until it stays `within` so many µm of `final`."""
    return (np.flatnonzero(np.abs(position - final) > within)[-1] + 1) / 10


@pytest.mark.parametrize(("method", "lines"), [("matched", MATCHED), ("tustin", TUSTIN)])
@pytest.mark.parametrize(
    ("command_um", "flag"), [(41.0, COMMAND_LIMITED), (80.0, DRIVE_LIMITED)], ids=["command limited", "drive limited"]
)
def test_a_limited_step_recovers(method, lines, command_um, flag):
    position, flags = recorded(lines, command_um)
    reference = np.full(TICKS, 40.0)
    linear = closed_loop(reference, method).position_um
    wound_up = closed_loop(reference, method, limit_um=min(command_um, 43.01835)).position_um
    assert np.any(flags & flag)
    assert not np.any(flags[500:])  # the limit was left again
    assert overshoot_percent(position) <= overshoot_percent(linear) + 1.0
    assert overshoot_percent(position) < 0.5 * overshoot_percent(wound_up)
    assert settling_ms(position) <= 1.5 * settling_ms(linear)
    assert settling_ms(position) < settling_ms(wound_up)


@pytest.mark.parametrize(("method", "lines"), [("matched", MATCHED), ("tustin", TUSTIN)])
def test_a_reference_out_of_reach_is_left_at_once(method, lines):
    """0.2 s at a 60 µm that the limit forbids, then back to 0: a controller that winds up comes back much later."""
    steps = '[axis.reference]\nkind = "steps"\nlevels = [60.0, 0.0]\ndwell_s = 0.2\nrepeat = false\n'
    bench = LoopBench(text(IDEAL, AXIS, EXACT, CONTROLLER, lines, LIMITS.format(42.0), steps))
    rows = bench.run(6000)
    reference = np.where(np.arange(6000) < 2000, 60.0, 0.0)
    back = bench.column(rows, "x_true_position_um")[2000:]
    wound_up = closed_loop(reference, method, limit_um=42.0).position_um[2000:]
    times = [settling_ms(response, 0.0, 1.0) for response in (back, wound_up)]
    assert np.all(bench.column(rows, "flags")[100:2000].astype(int) & COMMAND_LIMITED)
    assert times[0] < 10
    assert times[0] < times[1] / 5
    assert back.min() > -1.5

"""Mode changes on the rig under a sine: the demand makes no larger step than under the sine alone."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from tests.engine.harness import AXIS, CONTROLLER, IDEAL, MATCHED, TUSTIN, LoopBench, text

SWITCH, TICKS = 5137, 8000
SINES = {"raw": (2.5, 1.0), "feedforward": (12.0, 3.0), "closed_loop": (12.0, 3.0)}
PAPER_RIG = ""


def reference(mode: str) -> str:
    """Return a 5 Hz sine, in V for raw and in µm otherwise, that is not at rest when the mode changes."""
    amplitude, offset = SINES[mode]
    return f'{{ kind = "sine", amplitude = {amplitude}, offset = {offset}, frequency_hz = 5.0, phase_deg = 90.0 }}'


def run_mode_change(before: str, after: str | None, rig: str, lines: str) -> np.ndarray:
    """Return the demand (V) of each tick; at SWITCH the mode changes to `after`, or stays the same if that is None."""
    schedule = f'[[schedule]]\nat_tick = {SWITCH}\nmode = "{after}"\n' if after else ""
    if after:
        schedule += f"[[schedule]]\nat_tick = {SWITCH}\nreference = {reference(after)}\n"
    axis = AXIS.replace('name = "x"', f'name = "x"\nreference = {reference(before)}')
    bench = LoopBench(text(rig, axis, CONTROLLER, lines, schedule, mode=before))
    rows = bench.run(TICKS)
    modes = ["off", "raw", "feedforward", "closed_loop"]
    assert bench.column(rows, "mode")[-1] == modes.index(after or before)
    assert not np.any(bench.column(rows, "flags"))
    return bench.column(rows, "x_demand_v")


@pytest.mark.parametrize("rig", [IDEAL, PAPER_RIG], ids=["ideal sensor", "paper's rig"])
@pytest.mark.parametrize("lines", [MATCHED, TUSTIN], ids=["matched", "tustin"])
@pytest.mark.parametrize(("before", "after"), [*permutations(SINES, 2)])
def test_changes_are_bumpless(before, after, lines, rig):
    switched = run_mode_change(before, after, rig, lines)
    unswitched = run_mode_change(before, None, rig, lines)
    assert np.array_equal(switched[:SWITCH], unswitched[:SWITCH])
    bump_v = abs(switched[SWITCH] - switched[SWITCH - 1])
    sine_step_v = np.abs(np.diff(unswitched[SWITCH - 2000 :])).max()  # one period of the sine, long after the start
    assert bump_v <= 1.1 * sine_step_v


@pytest.mark.parametrize("rig", [IDEAL, PAPER_RIG], ids=["ideal sensor", "paper's rig"])
@pytest.mark.parametrize("lines", [MATCHED, TUSTIN], ids=["matched", "tustin"])
@pytest.mark.parametrize("before", ["raw", "feedforward"])
def test_closing_the_loop_on_a_large_error(before, lines, rig):
    """The reference is 12 µm away: the error decays with bump_s = 20 ms, and the drive moves no faster."""
    schedule = f'[[schedule]]\nat_tick = {SWITCH}\nmode = "closed_loop"\n'
    schedule += f'[[schedule]]\nat_tick = {SWITCH}\nreference = {{ kind = "hold", value = 12.0 }}\n'
    axis = AXIS.replace('name = "x"', 'name = "x"\nreference = { kind = "hold", value = 0.0 }')
    bench = LoopBench(text(rig, axis, CONTROLLER, lines, schedule, mode=before))
    rows = bench.run(TICKS + 6000)
    demand_v, position_um = bench.column(rows, "x_demand_v"), bench.column(rows, "x_true_position_um")
    glide_v = 12.0 / 2.5 * 1e-4 / 0.02  # the first step of a glide over 12 µm at the model's 2.5 µm/V
    after_v = np.abs(np.diff(demand_v[SWITCH - 1 :])).max()
    noise_v = np.abs(np.diff(demand_v[-2000:])).max()
    assert after_v <= 1.5 * glide_v + noise_v
    assert abs(position_um[-500:].mean() - 12.0) < 0.1

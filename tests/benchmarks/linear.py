"""The closed loop where it is linear, against the simulators that control engineers know."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import signal

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.drivers.sim import SimDriver
from rtloop.engine.plan import Plan
from rtloop.foundation.arrays import Real
from rtloop.signals import ERROR, FLAGS, POSITION, REFERENCE, axis_column
from tests.benchmarks.configurations import PAPER, RIG, STEPS, TEXT, changed
from tests.benchmarks.kernels import Differs
from tests.benchmarks.measure import Effort, NotMeasured, in_turn, ratio, seconds, spread
from tests.benchmarks.scenario import PythonLoop

TICKS = 50_000
TOLERANCE_UM = 1e-9
"""On positions of some µm: the three discretise and add up in different orders."""
HYSTERESIS = TEXT[TEXT.index("thresholds_v = [0.095") : TEXT.index("dead_band = ")]
LINEAR_RIG = """[driver]
kind = "sim"
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
[driver.plant]
adc = { range_v = 10.0, bits = 0 }
dac = { range_v = 10.0, bits = 0 }
[driver.plant.hysteresis]
truth = "custom"
thresholds_v = [0.0]
weights_um_per_v = [4.0]
[driver.plant.sensor]
um_per_v = 10.0
noise_um = 0.0
resolution_um = 0.0

"""
SMALL_STEPS = 'kind = "steps"\nlevels = [0.0, 4.0, -4.0]\ndwell_s = 0.2\n\n'
"""From rest, and small enough that nothing saturates."""


def linear_plan() -> Plan:
    """The paper's controller and plant with a gain in the hysteresis's place, ideal converters and sensor."""
    gain = "thresholds_v = [0.0]\nweights_um_per_v = [4.0]\n"
    text = changed((RIG, LINEAR_RIG), (HYSTERESIS, gain), (STEPS, SMALL_STEPS))
    return prepare(parse(text, "linear", PAPER.parent, "linear.toml"), paced=False).plan


def _chain(parts: list[tuple[Real, Real, Real, Real]]) -> tuple[Real, Real, Real, Real]:
    """Systems one after the other, as one state space."""
    a, b, c, d = parts[0]
    for a2, b2, c2, d2 in parts[1:]:
        above = np.hstack([a, np.zeros((len(a), len(a2)))])
        a, b = np.vstack([above, np.hstack([b2 @ c, a2])]), np.vstack([b, b2 @ d])
        c, d = np.hstack([d2 @ c, c2]), d2 @ d
    return a, b, c, d


def _sections(numerator: Any, denominator: Any, gain: float) -> list[tuple[Real, Real, Real, Real]]:
    """Factor by factor: expanded, the paper's polynomials would lose their digits."""
    padded = [*numerator, *[[1.0]] * (len(denominator) - len(numerator))]
    found = [signal.tf2ss(above, below) for above, below in zip(padded, denominator, strict=True)]
    a, b, c, d = found[0]
    return [(a, b, gain * c, gain * d), *found[1:]]


def closed_loop(period_s: float) -> tuple[Real, Real, Real, Real]:
    """Reference to position in z, by scipy alone: C(s) of eq (20) by Tustin's rule, D(s) of eq (5) with held inputs."""
    # eqs (20) and (5), paired so that no section has more zeros than poles
    controller = _sections(
        [[1.0, 7.9e6], [1.0, 971.0, 4.6e5], [1.0, 43.0, 1.4e7]],
        [[1.0, 8.8e4], np.polymul([1.0, 974.0], [1.0, 1.0]), [1.0, 1153.0, 1.6e7]],
        0.016,
    )
    plant = _sections(
        [np.polymul([1.0, -1.22e5], [1.0, 2.99e4]), np.polymul([1.0, -2.776e4], [1.0, -1.07e4]), [1.0, 1430.0],
         [1.0, 4.3e4, 3.2e9]],
        [[1.0, 1.54e4, 4.0e9], [1.0, 964.0, 3.95e9], [1.0, 925.0, 4.59e5], [1.0, 55.0, 1.4e7]],
        -20.7,
    )  # fmt: skip
    at_rad_s = 2 * np.pi * 595.5
    warped_s = 2 / at_rad_s * np.tan(at_rad_s * period_s / 2)
    ac, bc, cc, dc = signal.cont2discrete(_chain(controller), warped_s, method="bilinear")[:4]
    ap, bp, cp, _ = signal.cont2discrete(_chain(plant), period_s, method="zoh")[:4]
    a = np.block([[ac, -bc @ cp], [bp @ cc, ap - bp @ dc @ cp]])
    return a, np.vstack([bc, bp @ dc]), np.hstack([np.zeros((1, len(ac))), cp]), np.zeros((1, 1))


def linear(effort: Effort) -> dict[str, Any]:
    """Time for five seconds of the linear closed loop: the paper's controller and plant, a gain for the hysteresis,
    no noise, ideal converters. rtloop runs unpaced, and its time includes the records of its ticks.
    `control.forced_response` and `scipy.signal.dlsim` simulate the same loop, which scipy alone builds from the
    paper's factors. There is a figure only if positions agree to 1e-9 µm. Only the call of each simulator is
    timed; its system and its inputs are ready before.
    """
    try:
        import control
    except ImportError:
        raise NotMeasured("control is not installed; the extra `bench` has it") from None
    plan = linear_plan()
    period_s = 1.0 / plan.pacing.rate_hz
    loop, until = PythonLoop(plan), TICKS
    loop.run(TICKS)
    rows = loop.rows[:TICKS].copy()
    position_um, reference_um = rows[:, axis_column(0, POSITION)], rows[:, axis_column(0, REFERENCE)]
    matrices = closed_loop(period_s)
    system, time_s = control.ss(*matrices, period_s), np.arange(TICKS) * period_s

    def rtloop() -> None:
        nonlocal until
        until += TICKS
        loop.run(until)

    forced_response = lambda: control.forced_response(system, time_s, reference_um).outputs
    dlsim = lambda: signal.dlsim((*matrices, period_s), reference_um, time_s)[1][:, 0]
    _require_linear(plan, rows)
    for name, action in {"control.forced_response": forced_response, "scipy.signal.dlsim": dlsim}.items():
        difference_um = float(np.abs(np.asarray(action()) - position_um).max())
        if not difference_um <= TOLERANCE_UM:
            raise Differs(f"linear: {name} differs from the loop by {difference_um:g} µm")
    actions = {"rtloop": rtloop, "forced_response": forced_response, "dlsim": dlsim}
    taken = in_turn({name: lambda action=action: seconds(action) for name, action in actions.items()}, effort.pairs)
    found: dict[str, Any] = {f"{name}_ms": spread([1e3 * value for value in values]) for name, values in taken.items()}
    others = ("forced_response", "dlsim")
    return found | {f"times_faster_than_{name}": ratio(taken[name], taken["rtloop"]) for name in others}


def _require_linear(plan: Plan, rows: Real) -> None:
    """No limit, no trip, and something that moved. Raises Differs."""
    assert isinstance(plan.driver(), SimDriver)
    flags = int(np.bitwise_or.reduce(rows[:, FLAGS].astype(np.int64)))
    if flags or np.abs(rows[:, axis_column(0, ERROR)]).max() < 1.0:
        raise Differs(f"linear: the run was not linear, its flags are {flags}")

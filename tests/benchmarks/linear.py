"""Time of the linear closed loop in rtloop, and in simulators of `control` and `scipy` that give equal positions."""

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
from tests.benchmarks.kernels import ResultsDiffer
from tests.benchmarks.measure import Effort, MeasurementUnavailable, interleave, ratio, spread, time_call
from tests.benchmarks.scenario import PythonLoop

TICKS = 50_000
TOLERANCE_UM = 1e-9
"""Tolerance on positions of some µm: the three programs discretise and sum in different orders."""
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
"""Steps from rest, so small that no limit acts."""


def linear_plan() -> Plan:
    """Return the paper's loop with a gain in place of the hysteresis, and with ideal converters and sensor."""
    gain = "thresholds_v = [0.0]\nweights_um_per_v = [4.0]\n"
    text = changed((RIG, LINEAR_RIG), (HYSTERESIS, gain), (STEPS, SMALL_STEPS))
    return prepare(parse(text, "linear", PAPER.parent, "linear.toml"), paced=False).plan


def _chain(parts: list[tuple[Real, Real, Real, Real]]) -> tuple[Real, Real, Real, Real]:
    """Return the series connection of systems (a, b, c, d)."""
    a, b, c, d = parts[0]
    for a2, b2, c2, d2 in parts[1:]:
        top = np.hstack([a, np.zeros((len(a), len(a2)))])
        a, b = np.vstack([top, np.hstack([b2 @ c, a2])]), np.vstack([b, b2 @ d])
        c, d = np.hstack([d2 @ c, c2]), d2 @ d
    return a, b, c, d


def _sections(numerator: Any, denominator: Any, gain: float) -> list[tuple[Real, Real, Real, Real]]:
    """Return one system for each pair of factors: the paper's expanded polynomials would lose digits."""
    padded = [*numerator, *[[1.0]] * (len(denominator) - len(numerator))]
    sections = [signal.tf2ss(upper, lower) for upper, lower in zip(padded, denominator, strict=True)]
    a, b, c, d = sections[0]
    return [(a, b, gain * c, gain * d), *sections[1:]]


def closed_loop(period_s: float) -> tuple[Real, Real, Real, Real]:
    """Return the loop from reference to position in z: C(s), eq (20), by Tustin's rule; D(s), eq (5), inputs held."""
    # Equations (20) and (5); factors are paired so that no section has more zeros than poles.
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
        raise MeasurementUnavailable("control is not installed; the extra `bench` has it") from None
    plan = linear_plan()
    period_s = 1.0 / plan.pacing.rate_hz
    loop, until_tick = PythonLoop(plan), TICKS
    loop.run(TICKS)
    rows = loop.rows[:TICKS].copy()
    position_um, reference_um = rows[:, axis_column(0, POSITION)], rows[:, axis_column(0, REFERENCE)]
    matrices = closed_loop(period_s)
    system, time_s = control.ss(*matrices, period_s), np.arange(TICKS) * period_s

    def rtloop() -> None:
        nonlocal until_tick
        until_tick += TICKS
        loop.run(until_tick)

    forced_response = lambda: control.forced_response(system, time_s, reference_um).outputs
    dlsim = lambda: signal.dlsim((*matrices, period_s), reference_um, time_s)[1][:, 0]
    _require_linear(plan, rows)
    for name, action in {"control.forced_response": forced_response, "scipy.signal.dlsim": dlsim}.items():
        difference_um = float(np.abs(np.asarray(action()) - position_um).max())
        if not difference_um <= TOLERANCE_UM:
            raise ResultsDiffer(f"linear: {name} differs from the loop by {difference_um:g} µm")
    programs = {"rtloop": rtloop, "forced_response": forced_response, "dlsim": dlsim}
    actions = {name: lambda program=program: time_call(program) for name, program in programs.items()}
    durations_s = interleave(actions, effort.pairs)
    results: dict[str, Any] = {f"{name}_ms": spread([1e3 * s for s in values]) for name, values in durations_s.items()}
    for name in ("forced_response", "dlsim"):
        results[f"times_faster_than_{name}"] = ratio(durations_s[name], durations_s["rtloop"])
    return results


def _require_linear(plan: Plan, rows: Real) -> None:
    """Require that the output moved without a limit or a trip. Raises ResultsDiffer."""
    assert isinstance(plan.driver(), SimDriver)
    flags = int(np.bitwise_or.reduce(rows[:, FLAGS].astype(np.int64)))
    if flags or np.abs(rows[:, axis_column(0, ERROR)]).max() < 1.0:
        raise ResultsDiffer(f"linear: the run was not linear, its flags are {flags}")

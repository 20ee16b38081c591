"""The measured loop: the paper's closed loop on the simulated rig, in virtual time, without a recorder."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Pointers, Wiring
from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.clock import Clock, clock_context, unpaced_clock
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.plan import Plan
from rtloop.kernel.memory import LawMemory
from tests.benchmarks import native
from tests.benchmarks.configurations import PAPER

NO_RECORDER = 1 << 60


def paper_plan() -> Plan:
    """Return the plan of the paper's loop: steps of ±20 µm, each of which saturates the drive, and sensor noise."""
    return prepare(load(PAPER), paced=False).plan


def tripping_plan(after_ticks: int) -> Plan:
    """Return the paper's plan with closer limits and, after `after_ticks`, a step beyond them, which causes a trip."""
    plan = paper_plan()
    generators, coefficients = plan.generators.copy(), plan.coefficients.copy()
    dwell_ticks = int(generators["parameters"][0, 2])
    steps = np.resize(plan.table, after_ticks // dwell_ticks)
    generators["parameters"][0, :4] = 0, steps.size + 1, dwell_ticks, 0
    coefficients["position_limit_um"], coefficients["drive_max_v"] = 30.0, 8.0
    return replace(plan, generators=generators, coefficients=coefficients, table=np.append(steps, 40.0))


def plan_of_axes(count: int) -> Plan:
    """Return a plan with `count` axes like the paper's, each with a separate plant."""
    plan, names = paper_plan(), tuple(f"x{i}" for i in range(count))
    return replace(
        plan,
        axes=names,
        wiring={name: Wiring(f"adc{i}", f"dac{i}") for i, name in enumerate(names)},
        coefficients=np.repeat(plan.coefficients, count),
        generators=np.repeat(plan.generators, count),
        observed=tuple(f"{name}_{signal}" for name in names for signal in ("true_position_um", "hysteresis_um")),
    )


class Loop:
    """The loop of `rtloop run --unpaced` in this process, which never waits for a recorder."""

    def __init__(self, plan: Plan, law: LawMemory) -> None:
        self.block, self.law = SharedBlock.create(plan.sizes), law
        self._driver, self._clock = plan.driver(), clock_context(plan.pacing.rate_hz)
        pointers = self._driver.open()
        head, words = self.block.ring("ticks").head, self.block["words"]
        clock = unpaced_clock(self._clock, head, words, Word.RECORDER_CURSOR, NO_RECORDER)
        self.assembly = Assembly(plan, self.block, self._driver.facts, *self._functions(pointers, clock), law)
        self.run(0)

    def _functions(self, pointers: Pointers, clock: Clock) -> tuple[Pointers, Clock]:
        """Return the functions of driver and clock that the loop calls."""
        return pointers, clock

    @property
    def rows(self) -> np.ndarray[Any, Any]:
        """The records in the ring, one row a slot."""
        return self.block["ticks_slots"]

    def run(self, until_tick: int) -> None:
        """Run further ticks until `until_tick`."""
        self.assembly.run(until_tick)


class PythonLoop(Loop):
    """The loop compiled from Python."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan, law_at_rest(plan))


class NativeLoop(Loop):
    """The loop in C, with the baseline's laws, rig and clock, on the same records."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan, native.law_at_rest(plan))

    def _functions(self, pointers: Pointers, clock: Clock) -> tuple[Pointers, Clock]:
        return native.rig_pointers(pointers.context), native.unpaced_clock(clock)

    def run(self, until_tick: int) -> None:
        """Run further ticks until `until_tick`."""
        native.run_loop(self.assembly, until_tick)

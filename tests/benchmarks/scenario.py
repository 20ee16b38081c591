"""The run that is measured: the paper's closed loop on the simulated rig, in virtual time, without a recorder."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Wiring
from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.clock import clock_context, unpaced_clock
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.plan import Plan
from rtloop.hil.rig import build_rig
from rtloop.kernel.layout import Records
from tests.benchmarks import native
from tests.benchmarks.configurations import PAPER

NO_RECORDER = 1 << 60


def paper_plan() -> Plan:
    """Steps of ±20 µm with sensor noise: every step saturates the drive."""
    return prepare(load(PAPER), paced=False).plan


def tripping_plan(after_ticks: int) -> Plan:
    """The same with limits drawn closer, and then a step beyond them: a trip, and the ramp after it."""
    plan = paper_plan()
    generators, coefficients = plan.generators.copy(), plan.coefficients.copy()
    dwell_ticks = int(generators["parameters"][0, 2])
    steps = np.resize(plan.table, after_ticks // dwell_ticks)
    generators["parameters"][0, :4] = 0, steps.size + 1, dwell_ticks, 0
    coefficients["position_limit_um"], coefficients["drive_max_v"] = 30.0, 8.0
    return replace(plan, generators=generators, coefficients=coefficients, table=np.append(steps, 40.0))


def plan_of_axes(count: int) -> Plan:
    """The paper's axis `count` times, each on a plant of its own."""
    plan, names = paper_plan(), tuple(f"x{i}" for i in range(count))
    return replace(
        plan,
        axes=names,
        wiring={name: Wiring(f"adc{i}", f"dac{i}") for i, name in enumerate(names)},
        coefficients=np.repeat(plan.coefficients, count),
        generators=np.repeat(plan.generators, count),
        observed=tuple(f"{name}_{signal}" for name in names for signal in ("true_position_um", "hysteresis_um")),
    )


class PythonLoop:
    """The loop as `rtloop run --unpaced` has it in its process, with nobody to wait for."""

    def __init__(self, plan: Plan) -> None:
        self.block = SharedBlock.create(plan.sizes)
        self.law = law_at_rest(plan)
        self._driver = plan.driver()
        self._clock = clock_context(plan.pacing.rate_hz)
        head, words = self.block.ring("ticks").head, self.block["words"]
        clock = unpaced_clock(self._clock, head, words, Word.RECORDER_CURSOR, NO_RECORDER)
        self._assembly = Assembly(plan, self.block, self._driver.facts, self._driver.open(), clock, self.law)
        self._assembly.run(0)

    @property
    def rows(self) -> np.ndarray[Any, Any]:
        """Slots of the ring of records."""
        return self.block["ticks_slots"]

    def run(self, until_tick: int) -> None:
        """Run on."""
        self._assembly.run(until_tick)


class NativeLoop:
    """The same run by the C baseline, from the same bytes."""

    def __init__(self, plan: Plan) -> None:
        period_s = 1.0 / plan.pacing.rate_hz
        options: Any = plan.driver().options
        self.block = SharedBlock.create(plan.sizes)
        self.block["table"][: plan.table.size] = plan.table
        self.law = law_at_rest(plan)
        rig_coefficients, rig_state = build_rig(options, plan.axes, period_s)
        ring = self.block.ring("ticks")
        self._kept: dict[str, np.ndarray[Any, Any] | Records] = {
            "law_coefficients": self.law.coefficients,
            "law_state": self.law.axes,
            "loop_state": self.law.state,
            "rig_coefficients": rig_coefficients,
            "rig_state": rig_state,
            "generators": plan.generators.copy(),
            "table": self.block["table"],
            "words": self.block["words"],
            "head": ring.head,
            "marks": ring.marks,
            "slots": ring.slots,
            "last_drive_v": self.block["last_drive_v"],
        }
        self._run = np.zeros(1, native.RUN)
        for name, array in self._kept.items():
            self._run[name] = array.ctypes.data
        self._run["axes"], self._run["columns"], self._run["capacity"] = len(plan.axes), *ring.slots.shape[::-1]
        self._run["period_ns"], self._run["period_us"] = 1_000_000_000 / plan.pacing.rate_hz, period_s * 1e6
        self._run["heartbeat_timeout_ns"] = plan.pacing.heartbeat_timeout_s * 1e9

    @property
    def rows(self) -> np.ndarray[Any, Any]:
        """Slots of the ring of records."""
        return self.block["ticks_slots"]

    def run(self, until_tick: int) -> None:
        """Run on."""
        native.run_loop(self._run, until_tick)

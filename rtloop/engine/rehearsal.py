"""A loop without shared processes: a few ticks of the simulated rig in virtual time, within the caller's process."""

from __future__ import annotations

import numpy as np

from rtloop.drivers.base import Channel, Wiring
from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.clock import clock_context, paced_now, unpaced_clock
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.messages import MESSAGE
from rtloop.engine.plan import Pacing, Plan
from rtloop.law.layout import COEFFICIENTS
from rtloop.law.reference import GENERATOR
from rtloop.signals import Mode

REHEARSED_TICKS = 100


def rehearse() -> None:
    """Compile the loop, the clocks and the simulated rig by running them."""
    pacing = Pacing(rate_hz=1000.0, paced=False)
    wiring = {"x": Wiring("adc0", "dac0")}
    coefficients = np.zeros(1, COEFFICIENTS)
    coefficients["trip_slew_v_per_tick"] = Channel("dac0").maximum_v
    nothing = np.zeros(0, MESSAGE)
    plan = Plan("rehearsal", ("x",), pacing, REHEARSED_TICKS, "sim", {}, wiring, coefficients, Mode.OFF,
                np.zeros(1, GENERATOR), np.zeros(0), nothing, ("x_true_position_um", "x_hysteresis_um"))  # fmt: skip
    driver, block, context = plan.driver(), SharedBlock.create(plan.sizes), clock_context(pacing.rate_hz)
    ring = block.ring("ticks")
    clock = unpaced_clock(context, ring.head, block["words"], Word.RECORDER_CURSOR, ring.marks.size)
    assert paced_now.address
    Assembly(plan, block, driver.facts, driver.open(), clock, law_at_rest(plan)).run(REHEARSED_TICKS)

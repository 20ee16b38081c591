"""What the engine adds to a tick: the whole loop, less the same calls of clock, driver and law in a bare loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.memory import SharedBlock, Word
from rtloop.foundation.native.compiled import jit
from rtloop.foundation.native.pointers import call
from rtloop.kernel.access import axis_state
from rtloop.kernel.layout import CONDITIONS
from rtloop.kernel.memory import new_records
from rtloop.kernel.step import evaluate, update
from rtloop.signals import Mode
from tests.benchmarks.kernels import Differs, law_inputs, same_memory
from tests.benchmarks.measure import Effort, in_turn, seconds, spread
from tests.benchmarks.scenario import paper_plan
from tests.benchmarks.tape import Tape, due_clock

TICKS = 400_000
CLOCK_READS = 5
"""Of a tick: at the wake, after read, law and write, and before the record is published."""
FAR_AWAY_NS = 1 << 62


@jit
def bare_ticks(pointers, clock, law, conditions, references, buffers, ticks):
    """The calls of a tick in their order, and nothing around them. `buffers`: inputs, outputs, timing."""
    inputs, outputs, timing = buffers
    adc_v, reference, feed = np.empty(1), np.empty(1), np.zeros(1)
    for k in range(ticks):
        call(clock[0], clock[2], timing.ctypes.data)
        call(pointers[1], pointers[0], inputs.ctypes.data)
        call(clock[1], clock[2], timing.ctypes.data)
        adc_v[0], reference[0] = inputs[0], references[k]
        evaluate(law, adc_v, reference, feed, conditions[0])
        outputs[0] = axis_state(law, 0).drive_v
        call(clock[1], clock[2], timing.ctypes.data)
        call(pointers[2], pointers[0], outputs.ctypes.data)
        call(clock[1], clock[2], timing.ctypes.data)
        update(law)
        call(clock[1], clock[2], timing.ctypes.data)


@jit
def clock_reads(clock, timing, ticks):
    """The clock's part of a tick alone."""
    for _ in range(ticks):
        call(clock[0], clock[2], timing.ctypes.data)
        for _ in range(CLOCK_READS - 1):
            call(clock[1], clock[2], timing.ctypes.data)


@jit
def driver_calls(pointers, inputs, outputs, ticks):
    """The driver's part of a tick alone; the lowest status that it returned."""
    worst = 0
    for _ in range(ticks):
        worst = min(worst, call(pointers[1], pointers[0], inputs.ctypes.data))
        worst = min(worst, call(pointers[2], pointers[0], outputs.ctypes.data))
    return worst


class Whole:
    """The loop as its process has it, with ring, records, commands, snapshots, heartbeat, on the tape."""

    def __init__(self, adc_v: np.ndarray[Any, Any]) -> None:
        plan, self._ticks = paper_plan(), 0
        self.law, self._tape, self._block = law_at_rest(plan), Tape(adc_v), SharedBlock.create(plan.sizes)
        self._block.store(Word.HEARTBEAT_NS, FAR_AWAY_NS)
        clock, self._kept = due_clock(plan.pacing.rate_hz)
        pointers = self._tape.pointers()
        self._assembly = Assembly(plan, self._block, self._tape.facts, pointers, clock, self.law)
        self._assembly.run(0)

    def further(self) -> None:
        """TICKS more."""
        self._ticks += TICKS
        self._assembly.run(self._ticks)


class Bare:
    """The same calls without the engine."""

    def __init__(self, adc_v: np.ndarray[Any, Any], references: np.ndarray[Any, Any]) -> None:
        plan = paper_plan()
        self.law = law_at_rest(plan)
        self._tape, self._references = Tape(adc_v), references
        clock, self._kept = due_clock(plan.pacing.rate_hz)
        self._clock, self._pointers = tuple(clock), tuple(self._tape.pointers())[:3]
        self._buffers = np.zeros(4), np.zeros(1), np.zeros(4)
        self._conditions = new_records(CONDITIONS, 1)

    def further(self) -> None:
        """TICKS more."""
        law = self.law
        bare_ticks(self._pointers, self._clock, law.law, self._conditions, self._references, self._buffers, TICKS)

    def clock(self) -> None:
        """The clock alone."""
        clock_reads(self._clock, self._buffers[2], TICKS)

    def driver(self) -> None:
        """The driver alone."""
        driver_calls(self._pointers, self._buffers[0], self._buffers[1], TICKS)


def overhead(effort: Effort) -> dict[str, Any]:
    """ns a tick of the engine around law, driver and clock.

    - `whole`: the compiled loop of the loop's process (commands, references, heartbeat, interlocks' conditions,
      record, rings, snapshots). Its driver returns recorded readings; its clock is read as often as the paced
      clock but never waits.
    - `bare`: a loop of the same calls of clock, driver and law, on the same readings and references. The law ends
      with the same bits.
    - `engine`: the difference, pair by pair.
    - `clock_reads` (five) and `driver_calls` (two): parts of both loops, timed alone.
    """
    adc_v, references = law_inputs(TICKS)
    whole, bare = Whole(adc_v), Bare(adc_v, references)
    actions = {"whole": whole.further, "bare": bare.further, "clock_reads": bare.clock, "driver_calls": bare.driver}
    for number, action in enumerate(actions.values()):
        action()  # compiles
        if number == 1:
            _require_same_law(whole, bare)
    bare.law.axes[:], bare.law.state[:] = whole.law.axes, whole.law.state
    taken = in_turn({name: lambda action=action: seconds(action) for name, action in actions.items()}, effort.pairs)
    ns = {name: [value * 1e9 / TICKS for value in values] for name, values in taken.items()}
    ns["engine"] = [one - two for one, two in zip(ns["whole"], ns["bare"], strict=True)]
    return {f"{name}_ns": spread(values) for name, values in ns.items()}


def _require_same_law(whole: Whole, bare: Bare) -> None:
    """Both did the law's work, the same, in closed loop all the time. Raises Differs."""
    if not same_memory(whole.law, bare.law) or whole.law.state["mode"][0] != Mode.CLOSED_LOOP:
        raise Differs("overhead: the bare loop's law is not that of the whole loop")

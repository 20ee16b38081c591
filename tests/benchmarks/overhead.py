"""Time that the engine adds to a tick: the whole loop, less a bare loop of the same calls of clock, driver and law."""

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
from tests.benchmarks.kernels import ResultsDiffer, equal_law_memory, law_inputs
from tests.benchmarks.measure import Effort, interleave, spread, time_call
from tests.benchmarks.scenario import paper_plan
from tests.benchmarks.tape import Tape, due_clock

TICKS = 400_000
CLOCK_READS = 5
"""Readings of the clock in a tick: at the wake, after read, law and write, before the record is published."""
FAR_AWAY_NS = 1 << 62


@jit
def bare_ticks(pointers, clock, law, conditions, references, buffers, ticks):
    """Call clock, driver and law like `ticks` ticks of the engine do, alone. `buffers`: inputs, outputs, timing."""
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
    """Call the clock as often as `ticks` ticks do."""
    for _ in range(ticks):
        call(clock[0], clock[2], timing.ctypes.data)
        for _ in range(CLOCK_READS - 1):
            call(clock[1], clock[2], timing.ctypes.data)


@jit
def driver_calls(pointers, inputs, outputs, ticks):
    """Call the driver's read and write `ticks` times; return the lowest status."""
    lowest_status = 0
    for _ in range(ticks):
        lowest_status = min(lowest_status, call(pointers[1], pointers[0], inputs.ctypes.data))
        lowest_status = min(lowest_status, call(pointers[2], pointers[0], outputs.ctypes.data))
    return lowest_status


class EngineLoop:
    """The loop like in its process (ring, records, commands, snapshots, heartbeat), on the readings of a tape."""

    def __init__(self, adc_v: np.ndarray[Any, Any]) -> None:
        plan, self._ticks = paper_plan(), 0
        self.law, self._tape, self._block = law_at_rest(plan), Tape(adc_v), SharedBlock.create(plan.sizes)
        self._block.store(Word.HEARTBEAT_NS, FAR_AWAY_NS)
        clock, self._clock_context = due_clock(plan.pacing.rate_hz)
        pointers = self._tape.pointers()
        self._assembly = Assembly(plan, self._block, self._tape.facts, pointers, clock, self.law)
        self._assembly.run(0)

    def run_ticks(self) -> None:
        """Run TICKS further ticks."""
        self._ticks += TICKS
        self._assembly.run(self._ticks)


class BareLoop:
    """A loop with the calls of EngineLoop, without the engine."""

    def __init__(self, adc_v: np.ndarray[Any, Any], references: np.ndarray[Any, Any]) -> None:
        plan = paper_plan()
        self.law = law_at_rest(plan)
        self._tape, self._references = Tape(adc_v), references
        clock, self._clock_context = due_clock(plan.pacing.rate_hz)
        self._clock, self._pointers = tuple(clock), tuple(self._tape.pointers())[:3]
        self._buffers = np.zeros(4), np.zeros(1), np.zeros(4)
        self._conditions = new_records(CONDITIONS, 1)

    def run_ticks(self) -> None:
        """Run TICKS further ticks."""
        law = self.law
        bare_ticks(self._pointers, self._clock, law.law, self._conditions, self._references, self._buffers, TICKS)

    def clock(self) -> None:
        """Call the clock as often as TICKS ticks do."""
        clock_reads(self._clock, self._buffers[2], TICKS)

    def driver(self) -> None:
        """Call the driver's read and write TICKS times."""
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
    engine_loop, bare_loop = EngineLoop(adc_v), BareLoop(adc_v, references)
    actions = {"whole": engine_loop.run_ticks, "bare": bare_loop.run_ticks}
    actions |= {"clock_reads": bare_loop.clock, "driver_calls": bare_loop.driver}
    for number, action in enumerate(actions.values()):
        action()  # The first call compiles.
        if number == 1:
            _require_same_law(engine_loop, bare_loop)
    bare_loop.law.axes[:], bare_loop.law.state[:] = engine_loop.law.axes, engine_loop.law.state
    timed_actions = {name: lambda action=action: time_call(action) for name, action in actions.items()}
    durations_s = interleave(timed_actions, effort.pairs)
    ns = {name: [value * 1e9 / TICKS for value in values] for name, values in durations_s.items()}
    ns["engine"] = [whole_ns - bare_ns for whole_ns, bare_ns in zip(ns["whole"], ns["bare"], strict=True)]
    return {f"{name}_ns": spread(values) for name, values in ns.items()}


def _require_same_law(engine_loop: EngineLoop, bare_loop: BareLoop) -> None:
    """Require that both laws are in closed loop and equal in bits. Raises ResultsDiffer."""
    if not equal_law_memory(engine_loop.law, bare_loop.law) or engine_loop.law.state["mode"][0] != Mode.CLOSED_LOOP:
        raise ResultsDiffer("overhead: the laws of the bare loop and of the whole loop differ")

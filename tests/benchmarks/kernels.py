"""The law of a tick, and the whole unpaced loop with the rig, against the same in C, equal in bits."""

from __future__ import annotations

from typing import Any

import numpy as np

from rtloop.engine.assembly import law_at_rest
from rtloop.foundation.native.compiled import jit
from rtloop.kernel.access import axis_state, loop_state
from rtloop.kernel.layout import CONDITIONS
from rtloop.kernel.memory import LawMemory, new_records
from rtloop.kernel.step import evaluate, reset_trip, set_mode, update
from rtloop.signals import ADC, FLAGS, REFERENCE, Flag, Mode, axis_column
from tests.benchmarks import native
from tests.benchmarks.measure import Effort, Spread, alternately, seconds
from tests.benchmarks.scenario import NativeLoop, PythonLoop, paper_plan, plan_of_axes, tripping_plan

CHECKED_TICKS = 200_000
CHUNK = 50_000
TIMED_TICKS = 400_000
AXES_TICKS = 100_000
WANTED = Flag.COMMAND_LIMITED | Flag.DRIVE_LIMITED | Flag.RAMPING | Flag.TRIP_POSITION


class Differs(AssertionError):
    """Python and C do not do the same work: there is no ratio to print."""


@jit
def run_law(law, adc_v, references, modes, conditions, out):
    """The law over arrays of inputs, as `run_law` of loop.c."""
    adc, reference, feed = np.empty(1), np.empty(1), np.zeros(1)
    for k in range(adc_v.size):
        if modes[k] >= 0:
            reset_trip(law)
            set_mode(law, modes[k], False)
        adc[0], reference[0] = adc_v[k], references[k]
        evaluate(law, adc, reference, feed, conditions[0])
        update(law)
        state = axis_state(law, 0)
        out[k, 0], out[k, 1] = state.command_um, state.demand_v
        out[k, 2], out[k, 3] = state.drive_v, float(loop_state(law).tick_flags)


def law_inputs(ticks: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """The readings and references of a closed loop that ran before."""
    plan = paper_plan()
    loop = PythonLoop(plan)
    adc_v, references = np.empty(ticks), np.empty(ticks)
    for begin in range(0, ticks, CHUNK):
        loop.run(begin + CHUNK)
        rows = loop.rows[np.arange(begin, begin + CHUNK) % loop.rows.shape[0]]
        adc_v[begin : begin + CHUNK] = rows[:, axis_column(0, ADC)]
        references[begin : begin + CHUNK] = rows[:, axis_column(0, REFERENCE)]
    return adc_v, references


def check_law(adc_v: np.ndarray[Any, Any], references: np.ndarray[Any, Any]) -> None:
    """Equal bits in all modes, through limits, trips and unusable inputs. Raises Differs."""
    random = np.random.default_rng(1)
    adc_v, references = adc_v.copy(), references * np.where(np.arange(adc_v.size) % 30_000 < 5_000, 3.0, 1.0)
    modes = np.full(adc_v.size, -1)
    modes[::700] = random.choice([int(mode) for mode in Mode], modes[::700].size, p=[0.1, 0.2, 0.2, 0.5])
    adc_v[9_999::10_000] = random.choice([np.nan, np.inf, 9.995, -6.5], adc_v[9_999::10_000].size)
    outs = [np.empty((adc_v.size, 4)) for _ in range(2)]
    ours, theirs, conditions = law_at_rest(paper_plan()), native.law_at_rest(paper_plan()), new_records(CONDITIONS, 1)
    for memory in (ours, theirs):
        memory.state["mode"] = int(Mode.OFF)
    run_law(ours.law, adc_v, references, modes, conditions, outs[0])
    native.run_law(theirs, (adc_v, references, modes, conditions), adc_v.size, outs[1])
    _require_equal("law", outs[0], outs[1])
    if not same_memory(ours, theirs):
        raise Differs("law: the states differ")
    flags = np.bitwise_or.reduce(outs[0][:, 3].astype(np.int64))
    wanted = WANTED | Flag.TRIP_NON_FINITE | Flag.TRIP_SENSOR_RANGE
    if flags & wanted != wanted:
        raise Differs(f"the law's check saw only {Flag(int(flags))!r}")


def law(effort: Effort) -> dict[str, Any]:
    """ns a tick of the law alone in closed loop, in rtloop and in C; both must give the same bits.

    Both call controller and feedforward through the pointers in their slots, on the same records.
    """
    adc_v, references = law_inputs(CHECKED_TICKS)
    check_law(adc_v, references)
    modes, out = np.full(adc_v.size, -1), np.empty((adc_v.size, 4))
    ours, theirs, conditions = law_at_rest(paper_plan()), native.law_at_rest(paper_plan()), new_records(CONDITIONS, 1)
    pair = alternately(
        lambda: run_law(ours.law, adc_v, references, modes, conditions, out),
        lambda: native.run_law(theirs, (adc_v, references, modes, conditions), adc_v.size, out),
        effort.pairs,
    )
    if ours.state["mode"][0] != Mode.CLOSED_LOOP or not same_memory(ours, theirs):
        raise Differs("the law left closed loop, or its states differ")
    return _compared(pair, adc_v.size)


def check_loop() -> None:
    """Equal rows, events, number of snapshots and states through steps, saturation and a trip. Raises Differs."""
    plan = tripping_plan(CHECKED_TICKS - 10_000)
    python, baseline, flags = PythonLoop(plan), NativeLoop(plan), 0
    for begin in range(0, CHECKED_TICKS, CHUNK):
        python.run(begin + CHUNK)
        baseline.run(begin + CHUNK)
        slots = np.arange(begin, begin + CHUNK) % python.rows.shape[0]
        _require_equal(f"loop, from tick {begin}", python.rows[slots], baseline.rows[slots])
        flags |= int(np.bitwise_or.reduce(python.rows[slots, FLAGS].astype(np.int64)))
    for name in ("words", "events_slots", "events_marks", "snapshots_marks", "last_drive_v"):
        if python.block[name].tobytes() != baseline.block[name].tobytes():
            raise Differs(f"loop: {name} of the shared block differ")
    if not same_memory(python.law, baseline.law):
        raise Differs("loop: the states of the laws differ")
    if flags & WANTED != WANTED:
        raise Differs(f"the loop's check saw only {Flag(flags)!r}")


def loop(effort: Effort) -> dict[str, Any]:
    """ns a tick of the whole unpaced loop with the rig, without a recorder, in rtloop and in C, equal in bits.

    Both do the same: commands and events, a snapshot a second, driver, clock and laws behind pointers, interlocks,
    the record of the tick in the ring.
    """
    check_loop()
    plan = paper_plan()
    loops = PythonLoop(plan), NativeLoop(plan)
    ticks = [0, 0]

    def further(number: int) -> None:
        ticks[number] += TIMED_TICKS
        loops[number].run(ticks[number])

    pair = alternately(lambda: further(0), lambda: further(1), effort.pairs)
    _require_equal("loop, at the end", loops[0].rows, loops[1].rows)
    period_ns = 1e9 / plan.pacing.rate_hz
    result = _compared(pair, TIMED_TICKS)
    return result | {"times_real_time": period_ns / result["ns_per_tick"]["median"]}


def axes(effort: Effort) -> dict[str, Any]:
    """ns a tick of the unpaced loop with 1, 2, 4 and 8 axes, and the cost of a further axis, in rtloop and in C."""
    counts, makers = (1, 2, 4, 8), {"": PythonLoop, "c_": NativeLoop}
    loops = {(count, kind): make(plan_of_axes(count)) for count in counts for kind, make in makers.items()}
    taken: dict[tuple[int, str], list[float]] = {key: [] for key in loops}
    for repeat in range(1, effort.pairs + 2):
        for key, loop in loops.items():
            until = repeat * AXES_TICKS
            taken[key].append(seconds(lambda loop=loop, until=until: loop.run(until)) * 1e9 / AXES_TICKS)
    for count in counts:
        _require_equal(f"{count} axes, at the end", loops[count, ""].rows, loops[count, "c_"].rows)
    spreads = {(count, kind): Spread.of(values[1:]) for (count, kind), values in taken.items()}
    result: dict[str, Any] = {}
    for kind in makers:
        result |= {f"{kind}ns_per_tick_{count}": spreads[count, kind]._asdict() for count in counts}
    for kind in makers:
        result[f"{kind}ns_per_further_axis"] = (spreads[8, kind].minimum - spreads[1, kind].minimum) / 7
    return result


def same_memory(one: LawMemory, other: LawMemory) -> bool:
    """Whether two laws remember the same in bits, but for partial sums, which only compiled Python stores."""
    slots = "controller", "feedforward"
    pairs = [(one.axes, other.axes), (one.state, other.state)]
    pairs += [(one.slot_record(0, slot, "state"), other.slot_record(0, slot, "state")) for slot in slots]
    return all(
        mine[name].tobytes() == theirs[name].tobytes()
        for mine, theirs in pairs
        for name in mine.dtype.names
        if name not in (*slots, "sums", "tap_sums")
    )


def _compared(pair: Any, ticks: int) -> dict[str, Any]:
    scale = 1e9 / ticks
    return {
        "ns_per_tick": pair.first.scaled(scale)._asdict(),
        "c_ns_per_tick": pair.second.scaled(scale)._asdict(),
        "ratio": pair.ratio._asdict(),
        "ratio_of_minima": pair.first.minimum / pair.second.minimum,
    }


def _require_equal(what: str, ours: np.ndarray[Any, Any], theirs: np.ndarray[Any, Any]) -> None:
    """Equal in bits, all NaN being one."""
    ours, theirs = (np.where(np.isnan(values), np.nan, values).view(np.uint64) for values in (ours, theirs))
    if not np.array_equal(ours, theirs):
        first = np.argwhere(ours != theirs)[0]
        raise Differs(f"{what}: Python and C differ first at {first.tolist()}")

"""Time of a tick's law, and of the whole unpaced loop with the rig, in rtloop and in C, with results equal in bits."""

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
from tests.benchmarks.measure import Effort, Spread, time_alternately, time_call
from tests.benchmarks.scenario import NativeLoop, PythonLoop, paper_plan, plan_of_axes, tripping_plan

CHECKED_TICKS = 200_000
CHUNK = 50_000
TIMED_TICKS = 400_000
AXES_TICKS = 100_000
REQUIRED_FLAGS = Flag.COMMAND_LIMITED | Flag.DRIVE_LIMITED | Flag.RAMPING | Flag.TRIP_POSITION


class ResultsDiffer(AssertionError):
    """Two programs did not do the same work, so that their times must not be compared."""


@jit
def run_law(law, adc_v, references, modes, conditions, out):
    """Run the law over arrays of inputs, like `run_law` of loop.c; row k of `out`: command, demand, drive, flags."""
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
    """Run a closed loop; return its readings (V) and references (µm)."""
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
    """Compare both laws in bits, in all modes, at limits, trips and unusable inputs. Raises ResultsDiffer."""
    random = np.random.default_rng(1)
    adc_v, references = adc_v.copy(), references * np.where(np.arange(adc_v.size) % 30_000 < 5_000, 3.0, 1.0)
    modes = np.full(adc_v.size, -1)
    modes[::700] = random.choice([int(mode) for mode in Mode], modes[::700].size, p=[0.1, 0.2, 0.2, 0.5])
    adc_v[9_999::10_000] = random.choice([np.nan, np.inf, 9.995, -6.5], adc_v[9_999::10_000].size)
    outs = [np.empty((adc_v.size, 4)) for _ in range(2)]
    python, baseline = law_at_rest(paper_plan()), native.law_at_rest(paper_plan())
    conditions = new_records(CONDITIONS, 1)
    for memory in (python, baseline):
        memory.state["mode"] = int(Mode.OFF)
    run_law(python.law, adc_v, references, modes, conditions, outs[0])
    native.run_law(baseline, (adc_v, references, modes, conditions), adc_v.size, outs[1])
    _require_equal("law", outs[0], outs[1])
    if not equal_law_memory(python, baseline):
        raise ResultsDiffer("law: the states differ")
    flags = np.bitwise_or.reduce(outs[0][:, 3].astype(np.int64))
    required = REQUIRED_FLAGS | Flag.TRIP_NON_FINITE | Flag.TRIP_SENSOR_RANGE
    if flags & required != required:
        raise ResultsDiffer(f"the check of the law met only the flags {Flag(int(flags))!r}")


def law(effort: Effort) -> dict[str, Any]:
    """ns a tick of the law alone in closed loop, in rtloop and in C; both must give the same bits.

    Both call controller and feedforward through the pointers in their slots, on the same records.
    """
    adc_v, references = law_inputs(CHECKED_TICKS)
    check_law(adc_v, references)
    modes, out = np.full(adc_v.size, -1), np.empty((adc_v.size, 4))
    python, baseline = law_at_rest(paper_plan()), native.law_at_rest(paper_plan())
    conditions = new_records(CONDITIONS, 1)
    pair = time_alternately(
        lambda: run_law(python.law, adc_v, references, modes, conditions, out),
        lambda: native.run_law(baseline, (adc_v, references, modes, conditions), adc_v.size, out),
        effort.pairs,
    )
    if python.state["mode"][0] != Mode.CLOSED_LOOP or not equal_law_memory(python, baseline):
        raise ResultsDiffer("the law left closed loop, or its states differ")
    return _comparison(pair, adc_v.size)


def check_loop() -> None:
    """Compare rows, events, count of snapshots and states of both loops, also in a trip. Raises ResultsDiffer."""
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
            raise ResultsDiffer(f"loop: {name} of the shared block differ")
    if not equal_law_memory(python.law, baseline.law):
        raise ResultsDiffer("loop: the states of the laws differ")
    if flags & REQUIRED_FLAGS != REQUIRED_FLAGS:
        raise ResultsDiffer(f"the check of the loop met only the flags {Flag(flags)!r}")


def loop(effort: Effort) -> dict[str, Any]:
    """ns a tick of the whole unpaced loop with the rig, without a recorder, in rtloop and in C, equal in bits.

    Both do the same: commands and events, a snapshot a second, driver, clock and laws behind pointers, interlocks,
    the record of the tick in the ring.
    """
    check_loop()
    plan = paper_plan()
    loops = PythonLoop(plan), NativeLoop(plan)
    ticks = [0, 0]

    def run_further(number: int) -> None:
        ticks[number] += TIMED_TICKS
        loops[number].run(ticks[number])

    pair = time_alternately(lambda: run_further(0), lambda: run_further(1), effort.pairs)
    _require_equal("loop, at the end", loops[0].rows, loops[1].rows)
    period_ns = 1e9 / plan.pacing.rate_hz
    result = _comparison(pair, TIMED_TICKS)
    return result | {"times_real_time": period_ns / result["ns_per_tick"]["median"]}


def axes(effort: Effort) -> dict[str, Any]:
    """ns a tick of the unpaced loop with 1, 2, 4 and 8 axes, and the cost of a further axis, in rtloop and in C."""
    counts, makers = (1, 2, 4, 8), {"": PythonLoop, "c_": NativeLoop}
    loops = {(count, kind): make(plan_of_axes(count)) for count in counts for kind, make in makers.items()}
    tick_ns: dict[tuple[int, str], list[float]] = {key: [] for key in loops}
    for repeat in range(1, effort.pairs + 2):
        for key, loop in loops.items():
            until_tick = repeat * AXES_TICKS
            duration_s = time_call(lambda loop=loop, until_tick=until_tick: loop.run(until_tick))
            tick_ns[key].append(duration_s * 1e9 / AXES_TICKS)
    for count in counts:
        _require_equal(f"{count} axes, at the end", loops[count, ""].rows, loops[count, "c_"].rows)
    spreads = {(count, kind): Spread.from_values(values[1:]) for (count, kind), values in tick_ns.items()}
    result: dict[str, Any] = {}
    for kind in makers:
        result |= {f"{kind}ns_per_tick_{count}": spreads[count, kind]._asdict() for count in counts}
    for kind in makers:
        result[f"{kind}ns_per_further_axis"] = (spreads[8, kind].minimum - spreads[1, kind].minimum) / 7
    return result


def equal_law_memory(first: LawMemory, second: LawMemory) -> bool:
    """Return whether two laws' states are equal in bits, except partial sums, which only compiled Python stores."""
    slots = "controller", "feedforward"
    pairs = [(first.axes, second.axes), (first.state, second.state)]
    pairs += [(first.slot_record(0, slot, "state"), second.slot_record(0, slot, "state")) for slot in slots]
    return all(
        first_record[name].tobytes() == second_record[name].tobytes()
        for first_record, second_record in pairs
        for name in first_record.dtype.names
        if name not in (*slots, "sums", "tap_sums")
    )


def _comparison(pair: Any, ticks: int) -> dict[str, Any]:
    """Return ns a tick in rtloop and in C, and their ratios, from a Pair of durations of `ticks` ticks."""
    scale = 1e9 / ticks
    return {
        "ns_per_tick": pair.first.scaled(scale)._asdict(),
        "c_ns_per_tick": pair.second.scaled(scale)._asdict(),
        "ratio": pair.ratio._asdict(),
        "ratio_of_minima": pair.first.minimum / pair.second.minimum,
    }


def _require_equal(subject: str, python: np.ndarray[Any, Any], baseline: np.ndarray[Any, Any]) -> None:
    """Compare two arrays in bits; all NaN are equal. Raises ResultsDiffer."""
    python, baseline = (np.where(np.isnan(values), np.nan, values).view(np.uint64) for values in (python, baseline))
    if not np.array_equal(python, baseline):
        first = np.argwhere(python != baseline)[0]
        raise ResultsDiffer(f"{subject}: Python and C differ first at {first.tolist()}")

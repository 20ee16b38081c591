"""Clock of virtual time, whose ticks wake late if the plan says so: each by one number of a table, drawn at random.

A wake that is late by L after the deadline k·T, with T the period and m = ⌊L/T⌋, skips m whole periods, as the paced
clock does where the loop was late before its wait:

    deadline = (k + m)·T,      lateness = L − m·T,      periods missed = m,      next deadline = (k + m + 1)·T

Meanwhile the simulated rig advances by m periods with its outputs held. It has no other time than whole periods: the
rest of the lateness reaches the record and the interlocks alone. The table's numbers are taken to whole ns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.drivers.base import Facts, Pointers
from rtloop.drivers.sim import CONTEXT as RIG_CONTEXT
from rtloop.drivers.sim import SimDriver
from rtloop.engine.clock import CONTEXT as CLOCK_CONTEXT
from rtloop.engine.clock import Clock, clock_context, unpaced_clock
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.plan import Plan
from rtloop.foundation.native.compiled import cfunc, jit
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, call, carray
from rtloop.hil.stages.noise import next_word, seed_word

STREAM = "lateness of ticks"
"""Name of the stream of random numbers; no axis can have it, so that no sensor's noise is the same."""
NS_PER_US = 1000.0
_HALF = np.uint64(32)
_ADDRESSES = ("wait", "wait_context", "write", "rig", "held_v", "table_ns")
CONTEXT = np.dtype(
    [*((name, np.int64) for name in (*_ADDRESSES, "table_count", "output_count")), ("word", np.uint64)], align=True
)


class VirtualClock(NamedTuple):
    """A clock of virtual time and the arrays that it points to, which must outlive it."""

    clock: Clock
    arrays: tuple[npt.NDArray[np.generic], ...]


@cfunc(SIGNATURE)
def late_wait(context, timing):
    """Wait for the next tick on the wrapped clock, draw the tick's lateness, and write `timing`; return 0.

    A lateness of one period or more skips ticks: clock and rig advance by its whole periods. `timing` (4,) gets the
    tick's deadline and its wake in ns since the start, the number of skipped periods, and NaN. A status other than 0,
    from the wrapped clock or from the rig, is returned at once.
    """
    late = carray(context, 1, CONTEXT)[0]
    out = carray(timing, 4)
    status = call(late.wait, late.wait_context, out.ctypes.data)
    if status != 0:
        return status
    virtual = carray(address_pointer(late.wait_context), 1, CLOCK_CONTEXT)[0]
    deadline_ns, lateness_ns = out[0], _draw_ns(late)
    missed = np.int64(lateness_ns / virtual.period_ns)
    if missed > 0:
        status = _advance_rig(late, missed)
        if status != 0:
            return status
        virtual.index += missed
        out[0] = float(np.int64((virtual.index - 1) * virtual.period_ns))
    out[1] = max(deadline_ns + lateness_ns, out[0])
    out[2] = float(missed)
    return 0


@jit
def _draw_ns(late):
    """Return a random number of the table, in ns, each with equal probability."""
    late.word = next_word(late.word)
    table_ns = carray(address_pointer(late.table_ns), late.table_count, np.int64)
    return table_ns[np.int64(((late.word >> _HALF) * np.uint64(late.table_count)) >> _HALF)]


@jit
def _advance_rig(late, periods):
    """Advance the rig by a number of periods with its outputs held; return the first status other than 0, or 0.

    NaN holds the drive of a plant. A loopback channel would store NaN, and is written its present value.
    """
    rig = carray(address_pointer(late.rig), 1, RIG_CONTEXT)[0]
    held_v = carray(address_pointer(late.held_v), late.output_count, np.float64)
    loopback_v = carray(address_pointer(rig.looped_v), rig.looped, np.float64)
    for i in range(rig.looped):
        held_v[rig.count + i] = loopback_v[i]
    for _ in range(periods):
        status = call(late.write, late.rig, late.held_v)
        if status != 0:
            return status
    return 0


def virtual_clock(plan: Plan, facts: Facts, block: SharedBlock, pointers: Pointers, slack: int) -> VirtualClock:
    """Return the clock of virtual time of a plan, whose ticks are at most `slack` ahead of the recorder of `block`.

    `facts` and `pointers` belong to the open driver. Raises ValueError for simulated lateness with a driver other
    than the simulated rig in the loop's process.
    """
    pacing, context = plan.pacing, clock_context(plan.pacing.rate_hz)
    clock = unpaced_clock(context, block.ring("ticks").head, block["words"], Word.RECORDER_CURSOR, slack)
    if not pacing.simulated_lateness_us:
        return VirtualClock(clock, (context,))
    if plan.driver_kind != SimDriver.kind:
        raise ValueError(
            f"loop.simulated_lateness_us: set, but the driver is {plan.driver_kind!r}; allowed: only with the driver "
            f"{SimDriver.kind!r}; remove this key"
        )
    table_ns = np.rint(np.array(pacing.simulated_lateness_us) * NS_PER_US).astype(np.int64)
    held_v, late = np.full(len(facts.outputs), np.nan), np.zeros(1, CONTEXT)
    late["wait"], late["wait_context"] = clock.wait, clock.context
    late["write"], late["rig"] = pointers.write, pointers.context
    late["held_v"], late["output_count"] = held_v.ctypes.data, held_v.size
    late["table_ns"], late["table_count"] = table_ns.ctypes.data, table_ns.size
    late["word"] = seed_word(pacing.lateness_seed, STREAM)
    return VirtualClock(Clock(late_wait.address, clock.now, late.ctypes.data), (context, table_ns, held_v, late))

"""Loops in this process and in virtual time, without recorder and file."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.drivers.base import Driver
from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.late_clock import virtual_clock
from rtloop.engine.memory import SharedBlock, Sizes
from rtloop.engine.plan import Plan
from rtloop.foundation.arrays import Real
from rtloop.kernel.memory import LawMemory

SMALLEST_RING_RATE_HZ = 1.0
"""Low rate in place of the loop's, which makes the shared ring of records as short as it may be."""
BLOCKS_KEPT = 8
"""Shared blocks that are used again: as many as experiments of a campaign usually differ in size."""
UNLIMITED_SLACK = 1 << 62
"""Records by which the loop may be ahead of a recorder: without limit, as there is none."""


class _LawAtRest(NamedTuple):
    """Memory of laws, copies of its arrays at rest, and the plan that it was made for, which keeps `key` unique."""

    key: tuple[object, ...]
    plan: Plan
    memory: LawMemory
    arrays: dict[str, npt.NDArray[np.generic]]


class LoopsInProcess:
    """Runs loops one after the other; block and laws are used again where the next loop has the same."""

    def __init__(self) -> None:
        """Begin without blocks and laws that could be used again."""
        self._blocks: dict[Sizes, SharedBlock] = {}
        self._law: _LawAtRest | None = None

    def run(self, plan: Plan, driver: Driver, ticks: int, consume: Callable[[int, Real], None]) -> int:
        """Run `ticks` of a plan on a driver, which is not open yet; return the number of ticks that ran.

        `consume` is called for each full ring of ticks, and at the end for the rest, with the number of the first tick
        and the records, (n, columns) in the order of `plan.columns`; later ticks overwrite them. At the end the driver
        is closed, but not after an error. Raises ValueError for a law that cannot be compiled, for a channel that the
        driver lacks and for a clock that `virtual_clock` refuses, DriverError if the driver cannot be opened or closed,
        and the errors of `consume`.
        """
        block = self._empty_block(plan.sizes._replace(rate_hz=SMALLEST_RING_RATE_HZ))
        ring, facts, pointers = block.ring("ticks"), driver.facts, driver.open()
        virtual = virtual_clock(plan, facts, block, pointers, UNLIMITED_SLACK)
        assembly = Assembly(plan, block, facts, pointers, virtual.clock, self._law_memory(plan))
        ring_length = len(ring.slots)
        for first in range(0, ticks, ring_length):
            assembly.run(min(first + ring_length, ticks))
            count = int(assembly.loop.tick) - first
            consume(first, ring.slots[:count])
            if count < ring_length:  # The last ticks, or the loop has ended earlier.
                break
        driver.close()
        return int(assembly.loop.tick)

    def _law_memory(self, plan: Plan) -> LawMemory:
        """Return the memory of the plan's laws at rest: the stored one, restored, or a new one, which is then stored.

        The stored one fits plans with the mode, laws, extras and the same array of coefficients as the plan for which
        it was made. Raises ValueError as `law_at_rest`.
        """
        key = plan.mode, plan.laws, plan.extras, id(plan.coefficients)
        if self._law is None or self._law.key != key:
            memory = law_at_rest(plan)
            self._law = _LawAtRest(key, plan, memory, memory.copy_arrays())
        self._law.memory.restore_arrays(self._law.arrays)
        return self._law.memory

    def _empty_block(self, sizes: Sizes) -> SharedBlock:
        """Return an empty block of these sizes: one of an earlier call, emptied, or a new one.

        Blocks of the first BLOCKS_KEPT different sizes are kept for later calls.
        """
        if sizes in self._blocks:
            self._blocks[sizes].clear()
            return self._blocks[sizes]
        block = SharedBlock.create_private(sizes)
        if len(self._blocks) < BLOCKS_KEPT:
            self._blocks[sizes] = block
        return block


def run_in_process(plan: Plan, driver: Driver, ticks: int) -> Real:
    """Run `ticks` ticks of a plan on a driver, which is not open yet and is closed at the end, but not after an error.

    Returns all recorded columns (ticks, columns) in the order of `plan.columns`; fewer rows if the loop ends earlier.
    Raises the errors of `LoopsInProcess.run`.
    """
    records = np.empty((ticks, len(plan.columns)))

    def store(first: int, rows: Real) -> None:
        """Copy `rows`, the records of ticks from number `first` on, to `records`."""
        records[first : first + len(rows)] = rows

    return records[: LoopsInProcess().run(plan, driver, ticks, store)]

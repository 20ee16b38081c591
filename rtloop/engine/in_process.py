"""A loop in this process and in virtual time, without recorder and file."""

from __future__ import annotations

import os

import numpy as np

from rtloop.drivers.base import Driver
from rtloop.engine.assembly import Assembly, law_at_rest
from rtloop.engine.clock import clock_context, unpaced_clock
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.plan import Plan
from rtloop.foundation.arrays import Real

SMALLEST_RING_RATE_HZ = 1.0
"""Low rate in place of the loop's, which makes the shared ring of records as short as it may be."""
UNLIMITED_SLACK = 1 << 62
"""Records by which the loop may be ahead of a recorder: without limit, as there is none."""


def run_in_process(plan: Plan, driver: Driver, ticks: int) -> Real:
    """Run `ticks` of a plan on a driver, which is not open and is closed at the end.

    Returns all recorded columns (ticks, columns) in the order of `plan.columns`; fewer rows if the loop ends earlier.
    Raises ValueError for a law that cannot be compiled and for a channel that the driver lacks, DriverError if the
    driver cannot be opened.
    """
    context = clock_context(plan.pacing.rate_hz)
    block = SharedBlock.create(plan.sizes._replace(rate_hz=SMALLEST_RING_RATE_HZ))
    try:
        ring = block.ring("ticks")
        clock = unpaced_clock(context, ring.head, block["words"], Word.RECORDER_CURSOR, UNLIMITED_SLACK)
        assembly = Assembly(plan, block, driver.facts, driver.open(), clock, law_at_rest(plan))
        records, ring_length = np.empty((ticks, len(plan.columns))), len(ring.slots)
        for first in range(0, ticks, ring_length):
            assembly.run(min(first + ring_length, ticks))
            count = int(assembly.loop.tick) - first
            records[first : first + count] = ring.slots[:count]
        driver.close()
        return records[: int(assembly.loop.tick)]
    finally:
        os.close(block.fd)

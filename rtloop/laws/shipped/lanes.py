"""Sums that are computed four at a time, in an order that does not depend on the processor."""

from __future__ import annotations

from rtloop.foundation.native.compiled import jit

LANES = 4
"""Play operators, or pairs of controller states, in a block. Zero weights pad them to a multiple of LANES, so that
kernels need no remainder; counts have 8 bits, so that no index is negative."""
BLOCK = 2 * LANES
"""Controller states in a block: four, and then the partners of these four."""


@jit
def sum_lanes(sums, first, second, third, fourth):
    """Store the four numbers in `sums`, so that the compiler treats them as one vector; return (first + second) +
    (third + fourth).
    """
    sums[0], sums[1], sums[2], sums[3] = first, second, third, fourth
    return (first + second) + (third + fourth)

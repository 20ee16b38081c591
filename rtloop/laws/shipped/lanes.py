"""Sums that are computed four at a time, in an order that does not depend on the processor."""

from __future__ import annotations

from rtloop.foundation.native.compiled import jit

LANES = 4
"""Play operators and pairs of controller states in a block. What is in use is padded to a multiple of this with zero
weights, so that no kernel needs a remainder; counts have 8 bits, so that no index can be negative."""
BLOCK = 2 * LANES
"""Controller states in a block: four, and then the partners of these four."""


@jit
def sum_lanes(sums, first, second, third, fourth):
    """The sum of four partial sums. `sums` keeps them: stored side by side, they are one vector to the compiler."""
    sums[0], sums[1], sums[2], sums[3] = first, second, third, fourth
    return (first + second) + (third + fourth)

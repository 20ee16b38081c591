"""The transfer functions printed in the paper this software implements.

The rig in `hil` has another copy of D(s) on purpose: the plant and the model of the plant are independent.
"""

from rtloop.linear.transfer import Transfer

PAPER_D = Transfer.from_factors(
    -20.7,
    numerator=[[1, -1.22e5], [1, 2.99e4], [1, -2.776e4], [1, -1.07e4], [1, 1430], [1, 4.3e4, 3.2e9]],
    denominator=[[1, 925, 4.59e5], [1, 55, 1.4e7], [1, 1.54e4, 4e9], [1, 964, 3.95e9]],
)
"""Eq (5): the actuator's identified dynamics, µm per µm. D(0) = 1.0109 by the rounding of the printed gain."""

PAPER_C = Transfer.from_factors(
    0.016,
    numerator=[[1, 7.9e6], [1, 971, 4.6e5], [1, 43, 1.4e7]],
    denominator=[[1, 8.8e4], [1, 974], [1, 1], [1, 1153, 1.6e7]],
)
"""Eq (20): the reduced H∞ controller, µm of command per µm of error."""

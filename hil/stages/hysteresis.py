"""Prandtl-Ishlinskii hysteresis, the forward operator: y(t) = Σ p_i F_{r_i}[u](t), eq (4) of the paper.

The play operator with threshold r >= 0 is y = max(u − r, min(u + r, y₋)) (Krasnosel'skii & Pokrovskii 1989;
Kuhnen 2003). It is written with comparisons: a NaN drive then moves no play, and no sign of zero depends on how a
compiler orders min and max.

"The paper" is Rakotondrabe, Aljanaideh & Al Janaideh, "H∞ control for a smart micro-positioning system with an
analytical model for the output of the inverse compensation". This module must not use an inverse model.
"""

from __future__ import annotations

from rtloop.foundation.native.compiled import jit, jit_inline

MAX_PLAYS = 64

THRESHOLDS_V = (0.095, 0.38, 0.84, 1.46, 2.21, 3.07, 4.01, 4.98, 5.96, 6.89, 7.76, 8.52, 9.14, 9.61, 9.9)
"""Thresholds r_i of eq (4)."""

_INNER_UM_PER_V = (0.57, 1.3, -1.57, 1.25, -0.054)
_OUTER_UM_PER_V = (0.66, 0.16, -0.77, 2.02, -1.63, -0.15, 2.99, -1.09)

NOMINAL_WEIGHTS_UM_PER_V = (2.55, *_INNER_UM_PER_V, -0.032, *_OUTER_UM_PER_V)
"""Weights p_i of eq (4)."""

RESIDUAL_WEIGHTS_UM_PER_V = (2.3834, *_INNER_UM_PER_V, 0.25452, *_OUTER_UM_PER_V)
"""Eq (4) with p_0 and p_6 changed, so that an inverse computed from (4) leaves a loop of h/H = 3.75 % at 40 µm: the
real actuator differs from its model, and the paper is about the remaining loop."""

NAMED_MODELS = {
    "nominal": (THRESHOLDS_V, NOMINAL_WEIGHTS_UM_PER_V),
    "residual": (THRESHOLDS_V, RESIDUAL_WEIGHTS_UM_PER_V),
}
"""Thresholds [V] and weights [µm/V] by the value of `hysteresis.truth`."""

COEFFICIENTS = [
    ("play_count", "u1"),  # no more than 8 bits, so that no index can be negative
    ("thresholds_v", "f8", (MAX_PLAYS,)),
    ("weights_um_per_v", "f8", (MAX_PLAYS,)),
]
STATE = [("plays_v", "f8", (MAX_PLAYS,)), ("sums_um", "f8", (4,))]


@jit_inline
def play_output(drive_v, threshold_v, held_v):
    """Return the play operator's next output [V] after `held_v`: max(u − r, min(u + r, held)) for drive u, threshold r.

    A NaN drive leaves `held_v`.
    """
    low_v, high_v = drive_v - threshold_v, drive_v + threshold_v
    lowered_v = high_v if high_v < held_v else held_v
    return low_v if low_v > lowered_v else lowered_v


@jit
def step(coefficients, state, drive_v):
    """Move every play to `drive_v` and return the displacement y [µm], in four interleaved partial sums.

    NaN moves no play.
    """
    plays_v, weights, thresholds_v = state.plays_v, coefficients.weights_um_per_v, coefficients.thresholds_v
    first_um, second_um, third_um, fourth_um = 0.0, 0.0, 0.0, 0.0
    for block in range((coefficients.play_count + 3) // 4):  # the weights beyond the last play are 0
        i = 4 * block
        first_v = play_output(drive_v, thresholds_v[i], plays_v[i])
        second_v = play_output(drive_v, thresholds_v[i + 1], plays_v[i + 1])
        third_v = play_output(drive_v, thresholds_v[i + 2], plays_v[i + 2])
        fourth_v = play_output(drive_v, thresholds_v[i + 3], plays_v[i + 3])
        first_um += weights[i] * first_v
        second_um += weights[i + 1] * second_v
        third_um += weights[i + 2] * third_v
        fourth_um += weights[i + 3] * fourth_v
        plays_v[i], plays_v[i + 1], plays_v[i + 2], plays_v[i + 3] = first_v, second_v, third_v, fourth_v
    # Stored side by side, the four sums are one vector for the compiler.
    state.sums_um[0], state.sums_um[1], state.sums_um[2], state.sums_um[3] = first_um, second_um, third_um, fourth_um
    return (first_um + second_um) + (third_um + fourth_um)

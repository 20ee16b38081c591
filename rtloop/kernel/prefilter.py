"""Reference pre-filter: two rows of FIR taps on one history of references, and second-order sections behind the first.

    target[k] = Σ taps[i] r[k−i]  ─► sections ─► error              added[k] = Σ command_taps[i] r[k−i]  ─► command

The history is stored twice in succession, so that the taps read it in one piece, newest first, from any index. Its
length does not depend on the number of taps.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.native.compiled import jit, jit_rare
from rtloop.kernel.layout import MAX_TAPS, REFILL, TAP_LANES


@jit
def refill_prefilter(state):
    """Let the next reference fill the pre-filter's memory, as though it had been constant before."""
    state.tap_index = REFILL


@jit_rare
def tap_outputs_um(coefficients, state):
    """Return the outputs of both rows of taps for the stored history, in µm: target, addition to the command.

    Nothing advances. Without taps, or before the memory is filled, the target is a reference stored earlier, possibly
    long ago, and the addition 0.
    """
    if coefficients.tap_count == 0 or state.tap_index < 0:
        return state.tap_history[max(state.tap_index, 0)], 0.0
    return _tap_outputs_um(coefficients, state)


@jit
def _tap_outputs_um(coefficients, state):
    """Return the outputs of both rows of taps for the stored history, in µm: target, addition to the command.

    The memory must be filled. The sums have four lanes: the same order on every processor.
    """
    begin, history = np.uint8(state.tap_index), state.tap_history
    taps, command_taps = coefficients.taps, coefficients.command_taps
    x0, x1, x2, x3 = 0.0, 0.0, 0.0, 0.0
    v0, v1, v2, v3 = 0.0, 0.0, 0.0, 0.0
    for block in range(np.uint8(coefficients.tap_count) // TAP_LANES):
        i = block * TAP_LANES
        r0, r1, r2, r3 = history[begin + i], history[begin + i + 1], history[begin + i + 2], history[begin + i + 3]
        x0 += taps[i] * r0
        x1 += taps[i + 1] * r1
        x2 += taps[i + 2] * r2
        x3 += taps[i + 3] * r3
        v0 += command_taps[i] * r0
        v1 += command_taps[i + 1] * r1
        v2 += command_taps[i + 2] * r2
        v3 += command_taps[i + 3] * r3
    sums = state.tap_sums  # adjacent sums let the compiler use vectors
    sums[0], sums[1], sums[2], sums[3] = x0, x1, x2, x3
    sums[4], sums[5], sums[6], sums[7] = v0, v1, v2, v3
    return (x0 + x1) + (x2 + x3), (v0 + v1) + (v2 + v3)


@jit_rare
def _fill_memory(coefficients, state, value):
    """Set the memory of taps and sections to their rest at a constant reference `value`, in µm."""
    state.tap_index = 0
    for i in range(2 * MAX_TAPS):
        state.tap_history[i] = value
    if coefficients.tap_count > 0:
        value = tap_outputs_um(coefficients, state)[0]
    for i in range(coefficients.section_count):
        b0, b1, b2, a1, a2 = coefficients.sections[i]
        output = value * (b0 + b1 + b2) / (1.0 + a1 + a2)
        state.section_history[i, 0] = output - b0 * value
        state.section_history[i, 1] = b2 * value - a2 * output
        value = output


@jit
def filter_reference(coefficients, state, value):
    """Advance the pre-filter by the reference `value`, in µm. Returns (target, addition to the command), in µm.

    The taps make both, the sections filter the target alone; without taps the addition is 0. After `refill_prefilter`,
    the reference first fills the memory. The sections are second-order, in transposed direct form II.
    """
    if state.tap_index < 0:
        _fill_memory(coefficients, state, value)
    added_um = 0.0
    if coefficients.tap_count > 0:
        index = (state.tap_index if state.tap_index > 0 else MAX_TAPS) - 1
        state.tap_index = index
        state.tap_history[index] = state.tap_history[index + MAX_TAPS] = value
        value, added_um = _tap_outputs_um(coefficients, state)
    for i in range(coefficients.section_count):
        output = coefficients.sections[i, 0] * value + state.section_history[i, 0]
        state.section_history[i, 0] = (
            coefficients.sections[i, 1] * value - coefficients.sections[i, 3] * output + state.section_history[i, 1]
        )
        state.section_history[i, 1] = coefficients.sections[i, 2] * value - coefficients.sections[i, 4] * output
        value = output
    return value, added_um

"""The reference pre-filter: two rows of FIR taps on one history of references, then second-order sections on the first.

    wanted[k] = Σ taps[i] r[k−i]  ─► sections ─► the error          added[k] = Σ command_taps[i] r[k−i]  ─► the command

The history is kept twice, one behind the other, so that the taps meet it in one piece, newest first, wherever it
begins; its length does not depend on how many taps are in use.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.native.compiled import jit, jit_rare
from rtloop.kernel.layout import MAX_TAPS, REFILL, TAP_LANES


@jit
def refill_prefilter(state):
    """Have the pre-filter begin with the next reference, as if that had stood for ever."""
    state.tap_index = REFILL


@jit_rare
def last_outputs_um(coefficients, state):
    """What both rows of taps made of the last reference, in µm, or would have made."""
    if coefficients.tap_count == 0 or state.tap_index < 0:
        return state.tap_history[max(state.tap_index, 0)], 0.0
    return _tap_outputs_um(coefficients, state)


@jit
def _tap_outputs_um(coefficients, state):
    """Both rows of taps on the history, in µm; in four lanes each, an order that does not depend on the processor."""
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
    sums = state.tap_sums  # stored side by side, they are vectors to the compiler
    sums[0], sums[1], sums[2], sums[3] = x0, x1, x2, x3
    sums[4], sums[5], sums[6], sums[7] = v0, v1, v2, v3
    return (x0 + x1) + (x2 + x3), (v0 + v1) + (v2 + v3)


@jit_rare
def _fill_memory(coefficients, state, value):
    """The pre-filter's memory at rest for a constant reference."""
    state.tap_index = 0
    for i in range(2 * MAX_TAPS):
        state.tap_history[i] = value
    if coefficients.tap_count > 0:
        value = last_outputs_um(coefficients, state)[0]
    for i in range(coefficients.section_count):
        b0, b1, b2, a1, a2 = coefficients.sections[i]
        output = value * (b0 + b1 + b2) / (1.0 + a1 + a2)
        state.section_history[i, 0] = output - b0 * value
        state.section_history[i, 1] = b2 * value - a2 * output
        value = output


@jit
def filter_reference(coefficients, state, value):
    """What is wanted of the position, and what is added to the command, for a reference; all in µm.

    The sections are second-order, in transposed direct form II.
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

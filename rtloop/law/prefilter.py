"""The reference pre-filter: FIR taps, then second-order sections."""

from __future__ import annotations

from rtloop.hil.native.compiled import jit, seldom
from rtloop.law.layout import ANEW


@jit
def fill_prefilter_anew(state):
    """Have the pre-filter begin with the next reference, as if that had stood for ever."""
    state.tap_index = ANEW


@seldom
def _filled(coefficients, state, value):
    """The pre-filter's memory at rest for a constant reference."""
    state.tap_index = 0
    total_taps = 0.0 if coefficients.tap_count > 0 else 1.0
    for i in range(coefficients.tap_count):
        state.tap_history[i] = value
        total_taps += coefficients.taps[i]
    value *= total_taps
    for i in range(coefficients.section_count):
        b0, b1, b2, a1, a2 = coefficients.sections[i]
        output = value * (b0 + b1 + b2) / (1.0 + a1 + a2)
        state.section_history[i, 0] = output - b0 * value
        state.section_history[i, 1] = b2 * value - a2 * output
        value = output


@jit
def prefilter(coefficients, state, value):
    """Reference after the FIR taps and the second-order sections (transposed direct form II), in µm."""
    if state.tap_index < 0:
        _filled(coefficients, state, value)
    if coefficients.tap_count > 0:
        index = state.tap_index if state.tap_index < coefficients.tap_count else 0
        state.tap_index = index + 1 if index + 1 < coefficients.tap_count else 0
        state.tap_history[index] = value
        value = 0.0
        for i in range(coefficients.tap_count):
            value += coefficients.taps[i] * state.tap_history[index]
            index = coefficients.tap_count - 1 if index == 0 else index - 1
    for i in range(coefficients.section_count):
        output = coefficients.sections[i, 0] * value + state.section_history[i, 0]
        state.section_history[i, 0] = (
            coefficients.sections[i, 1] * value - coefficients.sections[i, 3] * output + state.section_history[i, 1]
        )
        state.section_history[i, 1] = coefficients.sections[i, 2] * value - coefficients.sections[i, 4] * output
        value = output
    return value

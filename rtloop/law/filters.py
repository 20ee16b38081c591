"""The linear parts of the law: controller C(z) in state space, reference pre-filter."""

from __future__ import annotations

from hil.compiled import jit


@jit
def controller_output(coefficients, state, error_um):
    """Command v = c x + d e in µm."""
    command = coefficients.d * error_um
    for i in range(coefficients.order):
        command += coefficients.c[i] * state.controller[i]
    return command


@jit
def controller_update(coefficients, state, error_um, shortfall_um):
    """x⁺ = A (x + m (v_applied − v)) + b e: the state as if C had commanded what was really applied.

    The vector m has c·m = 1 (observer form of anti-windup; Åström and Wittenmark, Computer-Controlled Systems, 1997).
    """
    for i in range(coefficients.order):
        state.scratch[i] = state.controller[i] + coefficients.tracking[i] * shortfall_um
    for i in range(coefficients.order):
        moved = coefficients.b[i] * error_um
        for j in range(coefficients.row_start[i], coefficients.row_stop[i]):
            moved += coefficients.a[i, j] * state.scratch[j]
        state.controller[i] = moved


@jit
def controller_enter(coefficients, state, error_um, command_um):
    """State from which C continues at `command_um`: its steady state for the error, corrected along m."""
    for i in range(coefficients.order):
        state.controller[i] = coefficients.steady_state[i] * error_um
    gap = command_um - controller_output(coefficients, state, error_um)
    for i in range(coefficients.order):
        state.controller[i] += coefficients.tracking[i] * gap


@jit
def prefilter(coefficients, state, value):
    """Reference after the FIR taps and the second-order sections (transposed direct form II), in µm."""
    if coefficients.tap_count > 0:
        index = state.tap_index
        state.tap_history[index] = value
        value = 0.0
        for i in range(coefficients.tap_count):
            value += coefficients.taps[i] * state.tap_history[index]
            index = coefficients.tap_count - 1 if index == 0 else index - 1
        state.tap_index = 0 if state.tap_index + 1 == coefficients.tap_count else state.tap_index + 1
    for i in range(coefficients.section_count):
        output = coefficients.sections[i, 0] * value + state.section_history[i, 0]
        state.section_history[i, 0] = (
            coefficients.sections[i, 1] * value - coefficients.sections[i, 3] * output + state.section_history[i, 1]
        )
        state.section_history[i, 1] = coefficients.sections[i, 2] * value - coefficients.sections[i, 4] * output
        value = output
    return value

"""The linear parts of the law: controller C(z) in state space, reference pre-filter."""

from __future__ import annotations

from rtloop.hil.native.compiled import inlined, jit, seldom
from rtloop.law.hysteresis import total
from rtloop.law.layout import ANEW, BLOCK, LANES


@jit
def controller_output(coefficients, state, error_um):
    """Command v = c x + d e in µm.

    Plainly: s[i mod 4] += c_i x_i + c_i+4 x_i+4 for i = 0 … 3, 8 … 11, …, then (s0 + s1) + (s2 + s3) + d e.
    """
    c, x = coefficients.c, state.controller
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for block in range(coefficients.order // BLOCK):
        i = block * BLOCK
        first += c[i] * x[i] + c[i + 4] * x[i + 4]
        second += c[i + 1] * x[i + 1] + c[i + 5] * x[i + 5]
        third += c[i + 2] * x[i + 2] + c[i + 6] * x[i + 6]
        fourth += c[i + 3] * x[i + 3] + c[i + 7] * x[i + 7]
    return total(state.sums, first, second, third, fourth) + coefficients.d * error_um


@jit
def controller_update(coefficients, state, error_um, shortfall_um):
    """x⁺ = A (x + m (v_applied − v)) + b e: the state as if C had commanded what was really applied.

    The vector m has c·m = 1 (observer form of anti-windup; Åström and Wittenmark, Computer-Controlled Systems, 1997).
    """
    if coefficients.coupled != 0:
        for i in range(coefficients.order):
            state.scratch[i] = state.controller[i] + coefficients.tracking[i] * shortfall_um
    x = state.controller
    for block in range(coefficients.order // BLOCK):
        i = block * BLOCK
        one, partner_of_one = _moved_pair(coefficients, state, i, error_um, shortfall_um)
        two, partner_of_two = _moved_pair(coefficients, state, i + 1, error_um, shortfall_um)
        three, partner_of_three = _moved_pair(coefficients, state, i + 2, error_um, shortfall_um)
        four, partner_of_four = _moved_pair(coefficients, state, i + 3, error_um, shortfall_um)
        x[i], x[i + 1], x[i + 2], x[i + 3] = one, two, three, four
        x[i + 4], x[i + 5], x[i + 6], x[i + 7] = partner_of_one, partner_of_two, partner_of_three, partner_of_four
    if coefficients.coupled != 0:
        for i in range(coefficients.order):
            for j in range(coefficients.row_start[i], coefficients.row_stop[i]):
                state.controller[i] += coefficients.coupling[i, j] * state.scratch[j]


@inlined
def _moved_pair(coefficients, state, i, error_um, shortfall_um):
    """States i and i + LANES after a tick, as far as they depend on each other and on the inputs."""
    j = i + LANES
    first = state.controller[i] + coefficients.tracking[i] * shortfall_um
    second = state.controller[j] + coefficients.tracking[j] * shortfall_um
    return (
        coefficients.own[i] * first + coefficients.partner[i] * second + coefficients.b[i] * error_um,
        coefficients.own[j] * second + coefficients.partner[j] * first + coefficients.b[j] * error_um,
    )


@seldom
def controller_enter(coefficients, state, error_um, command_um):
    """State from which C continues at `command_um`: its steady state for the error, corrected along m."""
    for i in range(coefficients.order):
        state.controller[i] = coefficients.steady_state[i] * error_um
    gap = command_um - controller_output(coefficients, state, error_um)
    for i in range(coefficients.order):
        state.controller[i] += coefficients.tracking[i] * gap


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

"""True positions between ticks: the rig's modes at several points of each period, from a record of a run.

A mode z⁺ = λz + u, λ = exp(pT), has after the fraction f of a period the state λᶠz + u(λᶠ − 1)/(λ − 1), with
λᶠ = exp(pTf). The kernel advances modes and disturbance as the rig did, so that its positions at ticks are the
recorded ones, in bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.native.compiled import jit, python_entry
from rtloop.foundation.native.pointers import address_pointer, carray
from rtloop.hil.rig import COEFFICIENTS, STATE
from rtloop.hil.stages import disturbance, dynamics

PARTS = 4
"""Real and imaginary part of λᶠ, then of (λᶠ − 1)/(λ − 1)."""


class RecordedMotion(NamedTuple):
    """Motion of the rig in a recorded run, one row for each tick.

    `hysteresis_um` (ticks, axes) is the displacement of the actuators in the period that ended at the tick, `missed`
    (ticks,) the number of periods that passed before it without a tick.
    """

    hysteresis_um: npt.NDArray[np.float64]
    missed: npt.NDArray[np.float64]


def fractions_of_period(coefficients: np.record, period_s: float, points: int) -> npt.NDArray[np.float64]:
    """Return the factors that move each mode of an axis from a tick to `points` instants of the next period.

    Instant i, from 0 on, lies i/points of `period_s` after the tick. The array (modes, PARTS, points) has real and
    imaginary part of λᶠ, the factor of the mode's state, then real and imaginary part of (λᶠ − 1)/(λ − 1), the factor
    of its constant input; λ is the mode's factor in one period, f = i/points.
    """
    count = coefficients.mode_count
    exponents = (coefficients.pole_real[:count] + 1j * coefficients.pole_imag[:count])[:, None] * period_s
    place = np.arange(points) / points
    powers: npt.NDArray[np.complex128] = np.exp(exponents * place)
    decays: npt.NDArray[np.complex128] = np.exp(exponents)
    with np.errstate(invalid="ignore"):
        inputs: npt.NDArray[np.complex128] = np.where(decays == 1, place, (powers - 1) / (decays - 1))
    return np.ascontiguousarray(np.stack([powers.real, powers.imag, inputs.real, inputs.imag], axis=1))


def positions_between_ticks(
    coefficients: np.recarray, state: np.recarray, axis: int, factors: npt.NDArray[np.float64], motion: RecordedMotion
) -> npt.NDArray[np.float64]:
    """Return the true positions of axis number `axis` in µm, (ticks, points): row k is the period from tick k on.

    `coefficients` and `state` (axes,) are the rig's records before the first tick; neither changes. `factors` is a
    result of `fractions_of_period`. Displacements after the last tick are not recorded, and count as unchanged; in
    periods without a tick they count as equal to the displacements in the period before the next tick. Raises
    ValueError for a motion with another number of axes or of counts, for an axis number that does not exist, and for
    factors whose shape does not fit the axis or that are not stored row by row.
    """
    displacements_um, missed = np.ascontiguousarray(motion.hysteresis_um), np.ascontiguousarray(motion.missed)
    ticks, axes = displacements_um.shape
    modes, parts, points = factors.shape
    if axes != len(coefficients) or missed.shape != (ticks,) or not 0 <= axis < axes:
        raise ValueError(
            f"recorded motion: the displacements have {axes} axes and {ticks} ticks, the missed periods have "
            f"{missed.size} counts, and the axis number is {axis}; allowed: {len(coefficients)} axes, {ticks} counts, "
            f"axis numbers from 0 to {len(coefficients) - 1}"
        )
    if (modes, parts) != (coefficients["mode_count"][axis], PARTS) or not factors.flags.c_contiguous:
        raise ValueError(
            f"factors: the array has the shape {modes} × {parts} × {points}; allowed: "
            f"{coefficients['mode_count'][axis]} × {PARTS} × any number, stored row by row; use the result of "
            "fractions_of_period for this axis"
        )
    own_state, positions_um = state[axis : axis + 1].copy(), np.empty((ticks, points))
    _fill_positions(
        coefficients[axis : axis + 1].ctypes.data, own_state.ctypes.data, axis, factors.ctypes.data, points, modes,
        displacements_um.ctypes.data, axes, missed.ctypes.data, ticks, positions_um.ctypes.data,
    )  # fmt: skip
    return positions_um


@python_entry("int64(intp, intp, int64, intp, int64, int64, intp, int64, intp, int64, intp)")
def _fill_positions(
    coefficients_address, state_address, axis, factors_address, points, modes, displacements, axes, missed, ticks, out
):
    """Fill `out` (ticks, points) with positions in µm, as `positions_between_ticks` describes; return 0.

    The other arguments are addresses of arrays, or numbers of points, modes, axes and ticks. The record at
    `state_address` is advanced by all periods.
    """
    coefficients = carray(address_pointer(coefficients_address), 1, COEFFICIENTS)[0]
    state = carray(address_pointer(state_address), 1, STATE)[0]
    factors = carray(address_pointer(factors_address), (modes, PARTS, points), np.float64)
    displacements_um = carray(address_pointer(displacements), (ticks, axes), np.float64)
    periods_missed = carray(address_pointer(missed), ticks, np.float64)
    positions_um = carray(address_pointer(out), (ticks, points), np.float64)
    for k in range(ticks):
        for _ in range(np.int64(periods_missed[k])):
            dynamics.step(coefficients, state, _input_um(coefficients, state, displacements_um[k], axis))
        true_um, _ = dynamics.observe(coefficients, state)
        input_um = _input_um(coefficients, state, displacements_um[min(k + 1, ticks - 1)], axis)
        _fill_period(coefficients, state, factors, input_um, positions_um[k])
        positions_um[k, 0] = true_um
        dynamics.step(coefficients, state, input_um)
    return 0


@jit
def _input_um(coefficients, state, displacements_um, axis):
    """Return the input (µm) of the dynamics of axis `axis` in a period, and advance its disturbance by a period.

    `displacements_um` (axes,) holds the displacement of each axis; the input contains other axes by their coupling.
    """
    total_um = displacements_um[axis]
    for j in range(coefficients.coupled_count):
        total_um += coefficients.coupling[j] * displacements_um[j]
    return total_um + disturbance.step(coefficients, state)


@jit
def _fill_period(coefficients, state, factors, input_um, positions_um):
    """Fill `positions_um` (points,) with the true positions in a period of constant `input_um`; `state` stays.

    `state` has the modes at the period's tick; `factors` is a result of `fractions_of_period`.
    """
    for j in range(positions_um.shape[0]):
        positions_um[j] = coefficients.true_direct * input_um
    for i in range(factors.shape[0]):
        mode_real, mode_imag = state.modes_real[i], state.modes_imag[i]
        true_real, true_imag = coefficients.true_real[i], coefficients.true_imag[i]
        powers_real, powers_imag, inputs_real, inputs_imag = factors[i, 0], factors[i, 1], factors[i, 2], factors[i, 3]
        for j in range(positions_um.shape[0]):
            real = powers_real[j] * mode_real - powers_imag[j] * mode_imag + inputs_real[j] * input_um
            imag = powers_imag[j] * mode_real + powers_real[j] * mode_imag + inputs_imag[j] * input_um
            positions_um[j] += true_real * real + true_imag * imag

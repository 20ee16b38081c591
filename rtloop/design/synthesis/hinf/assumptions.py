"""Assumptions of H∞ synthesis on a generalised plant, each checked and named separately.

    (A, B2) can be stabilised, (C2, A) detected         otherwise no controller makes the loop stable
    D12 has full column rank, D21 full row rank         otherwise u costs nothing, or y is known without noise
    [A − jω B2; C1 D12] full column rank, [A − jω B1; C2 D21] full row rank for all ω

Without the last condition, the controller would have to cancel a zero on the imaginary axis (Zhou, Doyle & Glover 1996,
section 17.1).
"""

from __future__ import annotations

import numpy as np

from rtloop.design.synthesis.hinf.augment import GeneralisedPlant
from rtloop.foundation.arrays import Real

SMALL = 1e-10
"""A singular value is zero below this, relative to the largest of the same rows, each brought to length 1."""


class NoController(ValueError):
    """No controller exists, or none for this γ; the message says which condition fails."""


def check_assumptions(plant: GeneralisedPlant) -> None:
    """Raise NoController with every assumption that does not hold; axis zeros are checked only if all others hold."""
    faults = [
        *_unreachable_modes("stabilisability", "the command u does not move", plant.a, plant.b2),
        *_unreachable_modes("detectability", "the measurement y does not show", plant.a.T, plant.c2.T),
        *_rank_faults(plant),
    ]
    if not faults:
        faults += _axis_zeros("from u to z", plant.a, plant.b2, plant.c1, plant.d12)
        faults += _axis_zeros("from w to y", plant.a.T, plant.c2.T, plant.b1.T, plant.d21.T)
    if faults:
        raise NoController("; ".join(faults))


def _unreachable_modes(condition: str, problem: str, a: Real, b: Real) -> list[str]:
    """Return a fault for each mode in Re ≥ 0 that the inputs do not reach (Popov-Belevitch-Hautus); [] without one.

    `condition` and `problem` are words for its text.
    """
    faults = []
    for value in np.linalg.eigvals(a):
        if value.imag < 0 or value.real < -SMALL * max(abs(value), 1e-300):
            continue
        if _is_singular(np.hstack([a - value * np.eye(a.shape[0]), b.astype(complex)])):
            faults.append(
                f"{condition}: {problem} the mode at s = {_root(value)} rad/s, which is not stable. If a weight has "
                "this pole, move the pole to Re s < 0. If the plant has this pole, no controller stabilises the loop"
            )
    return faults


def _rank_faults(plant: GeneralisedPlant) -> list[str]:
    """Return a fault if D12 lacks full column rank, and one if D21 lacks full row rank; [] if both have it."""
    faults = []
    for name, matrix, requirement in (
        ("D12", plant.d12, "allowed: full column rank. Give every command u a weight at high frequencies"),
        ("D21", plant.d21.T, "allowed: full row rank. Give every measurement y a disturbance at high frequencies"),
    ):
        values = np.linalg.svd(matrix, compute_uv=False)
        rank = int(np.sum(values > SMALL * values.max(initial=0.0)))
        if rank < matrix.shape[1]:
            faults.append(f"rank: {name} has rank {rank} of {matrix.shape[1]}; {requirement}")
    return faults


def _axis_zeros(path_name: str, a: Real, b: Real, c: Real, d: Real) -> list[str]:
    """Return a fault for each zero on the imaginary axis: a mode of A − B D⁺C that (I − D D⁺) C does not observe.

    `path_name` is the text for the fault; [] without a zero.
    """
    solve = np.linalg.pinv(d)
    inner, residual_c = a - b @ solve @ c, c - d @ solve @ c
    faults = []
    for value in np.linalg.eigvals(inner):
        on_axis = abs(value.real) <= 1e-9 * max(abs(value), SMALL * float(np.linalg.norm(inner)))
        if value.imag < 0 or not on_axis:
            continue
        if _is_singular(np.vstack([inner - 1j * value.imag * np.eye(a.shape[0]), residual_c]).T):
            place = f"the path {path_name} has a zero at ω = {value.imag:.6g} rad/s"
            faults.append(
                f"imaginary-axis zero: {place}; usual cause: a pole of the plant or a zero of a weight without "
                "damping. Add a little damping to this pole or zero"
            )
    return faults


def _is_singular(matrix: Real) -> bool:
    """Whether the rows of `matrix`, each brought to length 1, are linearly dependent, to SMALL; True for a row of
    zeros.
    """
    lengths = np.linalg.norm(matrix, axis=1)
    if np.any(lengths == 0):
        return True
    values = np.linalg.svd(matrix / lengths[:, None], compute_uv=False)
    return bool(values[-1] <= SMALL * values[0])


def _root(value: complex) -> str:
    """Return a root as text, with ± its imaginary part."""
    return f"{value.real:.6g}" + (f" ± {value.imag:.6g}j" if value.imag else "")

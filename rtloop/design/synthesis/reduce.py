"""Order reduction of a controller by balancing: states are ranked by their effect from input to output.

    P = L Lᵀ, Q = R Rᵀ,   Rᵀ L = U Σ Vᵀ,   T = L V Σ^-½,   T⁻¹ = Σ^-½ Uᵀ Rᵀ

Moore, IEEE TAC 26, 1981, by the square-root method (Tombs & Postlethwaite, Int. J. Control 46, 1987). Of the balanced
states the first are kept. Truncation leaves the others out, which keeps C(∞); residualisation lets them follow at once
(Fernando & Nicholson, IEEE TAC 27, 1982), which keeps C(0), as a controller near an integrator needs. Both
differ from the original by at most 2 Σ σ_k over the states left out, at any frequency (Glover, Int. J. Control 39,
1984).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from rtloop.design.synthesis.gramian import modal_root, modal_vectors, real_modal_system, system_roots
from rtloop.foundation.arrays import Real
from rtloop.foundation.modal import ModalSystem, RepeatedPoles, modal_sum
from rtloop.linear.realisation import System, cascade, imaginary_axis_points, scale_states
from rtloop.linear.transfer import Transfer

ReductionMethod = Literal["residualise", "truncate"]
LEAST_RELATIVE = 1e-14
"""Hankel singular values below this fraction of the largest count as zero."""


class ReducedController(NamedTuple):
    """A controller of reduced order, `transfer`, with the Hankel singular values `hankel` of the stable original part.

    `error_bound` is 2 Σ σ_k over the states left out: the largest change of the response at any frequency. Unstable
    modes are kept and count in the order. Values that count as zero (LEAST_RELATIVE) are not in `hankel`.
    """

    transfer: Transfer
    hankel: Real
    error_bound: float


class _BalancedSystem(NamedTuple):
    """A stable part, and the change of coordinates x = forward·z, z = back·x that balances it; `hankel` falls."""

    system: System
    forward: Real
    back: Real
    hankel: Real


def hankel_singular_values(transfer: Transfer) -> Real:
    """Return the Hankel singular values σ of the stable part, falling; a state that is left out moves the response by
    up to about 2σ. Values that count as zero (LEAST_RELATIVE) are not returned.

    Raises ValueError for repeated poles beside unstable ones.
    """
    stable, _ = _split_stable(transfer)
    return _balance(stable).hankel


def order_within(hankel: Real, tolerance: float) -> int:
    """Return the smallest order whose error bound 2 Σ σ_k is at most `tolerance` of 2 Σ σ over all states of
    `hankel`.
    """
    tail_sums = np.append(np.cumsum(hankel[::-1])[::-1], 0.0)
    return int(np.argmax(tail_sums <= tolerance * tail_sums[0]))


def reduce_order(
    transfer: Transfer,
    order: int | None = None,
    method: ReductionMethod = "residualise",
    tolerance: float = 1e-3,
) -> ReducedController:
    """Reduce a transfer function to `order` poles, unstable ones included, by default to all unstable poles and as few
    stable ones as `tolerance` allows (`order_within`).

    The result has fewer poles than `order` where further states have no effect (LEAST_RELATIVE). "residualise" keeps
    the gain at 0 Hz, "truncate" the gain at infinity. Raises ValueError for an order that is negative, above the
    original's, or below the number of modes that are not stable, and for repeated poles beside unstable ones.
    """
    stable, unstable = _split_stable(transfer)
    balanced = _balance(stable)
    unstable_count = unstable.poles.size if unstable else 0
    stable_order = order_within(balanced.hankel, tolerance) if order is None else order - unstable_count
    if not 0 <= stable_order <= transfer.order - unstable_count:
        raise ValueError(
            f"order: {order}; allowed for a controller of order {transfer.order} with {unstable_count} modes that "
            f"are not stable: {unstable_count} to {transfer.order}"
        )
    order_kept = min(stable_order, balanced.hankel.size)
    error_bound = 2 * float(balanced.hankel[order_kept:].sum())
    reduced = _reduce_states(balanced, order_kept, method)
    return ReducedController(_add_unstable(reduced, unstable), balanced.hankel, error_bound)


def _split_stable(transfer: Transfer) -> tuple[ModalSystem | System, ModalSystem | None]:
    """Return the stable part with the direct gain, and the unstable modes or None.

    Raises ValueError for repeated poles beside unstable ones.
    """
    try:
        modal = modal_sum(transfer.zeros, transfer.poles, transfer.gain)
    except RepeatedPoles:
        modal = None
    if modal is not None:
        stable = modal.poles.real < 0
        unstable = ModalSystem(modal.poles[~stable], modal.residues[:, ~stable], np.zeros(1))
        return ModalSystem(
            modal.poles[stable], modal.residues[:, stable], modal.direct
        ), unstable if unstable.poles.size else None
    if not transfer.is_stable:
        raise ValueError(
            "the full controller has unstable poles and repeated poles; its order cannot be reduced. Change the "
            "specification slightly, so that no two poles of the controller are equal"
        )
    points = imaginary_axis_points(np.concatenate([transfer.zeros, transfer.poles]))
    return scale_states(cascade(transfer.zeros, transfer.poles, transfer.gain), points), None


def _balance(part: ModalSystem | System) -> _BalancedSystem:
    """Return a stable part, unchanged, with the change of coordinates that balances it and its Hankel singular values.

    `forward`, `back` and `hankel` leave out the states whose value is not above LEAST_RELATIVE of the largest.
    """
    if isinstance(part, ModalSystem):
        beta, gamma = modal_vectors(part)
        system = real_modal_system(part)
        input_root, output_root = modal_root(part.poles, beta), modal_root(np.conj(part.poles), np.conj(gamma))
    else:
        system = part
        input_root, output_root = system_roots(part)
    u, hankel, vh = np.linalg.svd(output_root.T @ input_root)
    count = int(np.sum(hankel > LEAST_RELATIVE * hankel.max(initial=0.0)))
    u, hankel, v = u[:, :count], hankel[:count], vh[:count].T
    forward, back = input_root @ v / np.sqrt(hankel), (output_root @ u / np.sqrt(hankel)).T
    return _BalancedSystem(system, forward, back, hankel)


def _reduce_states(balanced: _BalancedSystem, count: int, method: ReductionMethod) -> System:
    """Return the system of the first `count` balanced states, the others truncated or residualised.

    Only these states are computed: residualising G(s) is truncating G(1/s), which has the same balanced coordinates. So
    rounding in negligible states does not enter, and C(0) is preserved.
    """
    (a, b, c, direct), forward, back = balanced.system, balanced.forward[:, :count], balanced.back[:count]
    if method == "truncate":
        return System(back @ a @ forward, back @ b, c @ forward, direct)
    inverse = np.linalg.solve(a, np.column_stack([forward, b]))
    slow, at_rest = back @ inverse, c @ inverse  # of G(1/s): A⁻¹, A⁻¹b, and −c A⁻¹
    fast = np.linalg.inv(slow[:, :count])
    b_fast = fast @ slow[:, count]
    c_fast = at_rest[:count] @ fast
    return System(
        np.asarray(fast, dtype=float), b_fast, c_fast, direct - float(at_rest[count]) + float(c_fast @ slow[:, count])
    )


def _add_unstable(stable: System, unstable: ModalSystem | None) -> Transfer:
    """Return the transfer function of both parts in parallel."""
    if unstable is None:
        return Transfer.from_state_space(*stable)
    unstable_system = unstable.realise()
    n, m = stable.b.size, unstable_system.b.size
    a = np.block([[stable.a, np.zeros((n, m))], [np.zeros((m, n)), unstable_system.a]])
    return Transfer.from_state_space(
        a, np.concatenate([stable.b, unstable_system.b]), np.concatenate([stable.c, unstable_system.c[0]]), stable.d
    )

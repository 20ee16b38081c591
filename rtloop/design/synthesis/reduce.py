"""Order reduction of a controller by balancing: its states in the order of what input and output make of them.

    P = L Lᵀ, Q = R Rᵀ,   Rᵀ L = U Σ Vᵀ,   T = L V Σ^-½,   T⁻¹ = Σ^-½ Uᵀ Rᵀ

Moore, IEEE TAC 26, 1981, by the square-root method (Tombs & Postlethwaite, Int. J. Control 46, 1987). Of the balanced
states the first are kept. Truncation leaves the others out, which keeps C(∞); residualisation lets them follow at once
(Fernando & Nicholson, IEEE TAC 27, 1982), which keeps C(0), and is what a controller near an integrator needs. Both
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
"""States of a Hankel singular value below this part of the largest are numerically not there."""


class ReducedController(NamedTuple):
    """`transfer` of the order kept; `hankel` (n,) of the stable part of the original; `error_bound` = 2 Σ σ_k left out.

    Modes that are not stable are kept as they are, and count in the order.
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
    """σ (n,), falling, of the stable part; 2σ is about how far the response moves if the state goes."""
    stable, _ = _split_stable(transfer)
    return _balance(stable).hankel


def order_within(hankel: Real, tolerance: float) -> int:
    """The smallest order whose error bound 2 Σ σ_k is at most `tolerance` of 2 Σ σ over all states."""
    tail_sums = np.append(np.cumsum(hankel[::-1])[::-1], 0.0)
    return int(np.argmax(tail_sums <= tolerance * tail_sums[0]))


def reduce_order(
    transfer: Transfer,
    order: int | None = None,
    method: ReductionMethod = "residualise",
    tolerance: float = 1e-3,
) -> ReducedController:
    """The transfer function with `order` poles, by default as few as `tolerance` allows (see `order_within`).

    Raises ValueError for an order that is negative, above the original's, or below the number of modes that are not
    stable.
    """
    stable, unstable = _split_stable(transfer)
    balanced = _balance(stable)
    unstable_count = unstable.poles.size if unstable else 0
    stable_order = order_within(balanced.hankel, tolerance) if order is None else order - unstable_count
    if not 0 <= stable_order <= transfer.order - unstable_count:
        raise ValueError(
            f"order: {order} of a controller of order {transfer.order} with {unstable_count} modes that are not "
            "stable; "
            f"{unstable_count} to {transfer.order} are allowed"
        )
    order_kept = min(stable_order, balanced.hankel.size)
    error_bound = 2 * float(balanced.hankel[order_kept:].sum())
    reduced = _reduce_states(balanced, order_kept, method)
    return ReducedController(_add_unstable(reduced, unstable), balanced.hankel, error_bound)


def _split_stable(transfer: Transfer) -> tuple[ModalSystem | System, ModalSystem | None]:
    """The stable part and, where there are any, the modes that are not stable."""
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
        raise ValueError("poles: repeated ones beside unstable ones; such a controller cannot be reduced")
    points = imaginary_axis_points(np.concatenate([transfer.zeros, transfer.poles]))
    return scale_states(cascade(transfer.zeros, transfer.poles, transfer.gain), points), None


def _balance(part: ModalSystem | System) -> _BalancedSystem:
    """The balanced realisation without what is numerically not there."""
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


def _reduce_states(balanced: _BalancedSystem, keep: int, method: ReductionMethod) -> System:
    """The first `keep` states; the others left out, or at rest for good.

    Only the states that are kept are ever computed: residualising G(s) is truncating G(1/s), which has the same
    balanced coordinates. So the rounding in states that hardly exist stays out, and C(0) is that of the original.
    """
    (a, b, c, direct), forward, back = balanced.system, balanced.forward[:, :keep], balanced.back[:keep]
    if method == "truncate":
        return System(back @ a @ forward, back @ b, c @ forward, direct)
    inverse = np.linalg.solve(a, np.column_stack([forward, b]))
    slow, at_rest = back @ inverse, c @ inverse  # of G(1/s): A⁻¹, A⁻¹b, and −c A⁻¹
    fast = np.linalg.inv(slow[:, :keep])
    b_fast = fast @ slow[:, keep]
    c_fast = at_rest[:keep] @ fast
    return System(
        np.asarray(fast, dtype=float), b_fast, c_fast, direct - float(at_rest[keep]) + float(c_fast @ slow[:, keep])
    )


def _add_unstable(rest: System, unstable: ModalSystem | None) -> Transfer:
    """Both parts side by side."""
    if unstable is None:
        return Transfer.from_state_space(*rest)
    unstable_system = unstable.realise()
    n, m = rest.b.size, unstable_system.b.size
    a = np.block([[rest.a, np.zeros((n, m))], [np.zeros((m, n)), unstable_system.a]])
    return Transfer.from_state_space(
        a, np.concatenate([rest.b, unstable_system.b]), np.concatenate([rest.c, unstable_system.c[0]]), rest.d
    )

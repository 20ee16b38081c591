"""The generalised plant that H∞ synthesis starts from, and the loop that a controller closes around it.

    x' = A x + B1 w + B2 u        w: external inputs          z: outputs to keep small
    z  = C1 x + D11 w + D12 u     u: controller's output      y: controller's input
    y  = C2 x + D21 w + D22 u

`augment` builds it as in Figs 9-b and 9-c of the paper, eqs (10)-(12):

    w = (x_d, Ω_w)    z = (o1, o2) = (W1 e, W2 v)    u = v    y = e = x_d − D v − W3 Ω_w
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import realise_transfer
from rtloop.design.synthesis.weights import Weights
from rtloop.foundation.arrays import Complex, Real
from rtloop.linear.matrices import block_diagonal
from rtloop.linear.transfer import Transfer


class Matrices(NamedTuple):
    """x' = A x + B u, y = C x + D u with any number of inputs and outputs: (n, n), (n, m), (p, n), (p, m)."""

    a: Real
    b: Real
    c: Real
    d: Real

    def response(self, s: Complex) -> Complex:
        """Return D + C (sI − A)⁻¹ B at complex points `s` (k,), shape (k, p, m)."""
        pencil = s[:, None, None] * np.eye(self.a.shape[0]) - self.a
        inputs = np.broadcast_to(self.b.astype(complex), (s.size, *self.b.shape))
        return self.d + self.c @ np.linalg.solve(pencil, inputs)


class GeneralisedPlant(NamedTuple):
    """The plant x' = A x + B1 w + B2 u, z = C1 x + D11 w + D12 u, y = C2 x + D21 w + D22 u.

    There are n states, m1 and m2 inputs w and u, p1 and p2 outputs z and y; the controller's input is y, its output u.
    """

    a: Real
    b1: Real
    b2: Real
    c1: Real
    c2: Real
    d11: Real
    d12: Real
    d21: Real
    d22: Real

    def close_loop(self, controller: Matrices) -> Matrices:
        """Return F_l(P, K), the loop from w to z with u = K y; states of the plant, then of K.

        Raises ValueError if the loop is not well posed: I − D22·D_K is singular.
        """
        loop_matrix = np.eye(self.d22.shape[0]) - self.d22 @ controller.d
        if np.linalg.cond(loop_matrix) > 1e14:
            raise ValueError("controller: the loop is not well posed, because I − D22·D_K is singular")
        inverse = np.linalg.inv(loop_matrix)  # y = inverse (C2 x + D21 w + D22 C_K x_K)
        output_from_plant, output_from_w = inverse @ self.c2, inverse @ self.d21
        output_from_k = inverse @ self.d22 @ controller.c
        command_from_k = controller.c + controller.d @ output_from_k  # u = D_K (y for x_K = 0) + command_from_k x_K
        command_from_plant, command_from_w = controller.d @ output_from_plant, controller.d @ output_from_w
        a = np.block([
            [self.a + self.b2 @ command_from_plant, self.b2 @ command_from_k],
            [controller.b @ output_from_plant, controller.a + controller.b @ output_from_k],
        ])  # fmt: skip
        b = np.vstack([self.b1 + self.b2 @ command_from_w, controller.b @ output_from_w])
        c = np.hstack([self.c1 + self.d12 @ command_from_plant, self.d12 @ command_from_k])
        return Matrices(a, b, c, self.d11 + self.d12 @ command_from_w)


def augment(plant: Transfer, weights: Weights) -> GeneralisedPlant:
    """Return the paper's standard scheme for D(s) and W1, W2, W3: 8 + 1 + 1 + 1 = 11 states for eq (5).

    w = (reference x_d, disturbance Ω_w), z = (W1 e, W2 v), u = v, y = e = x_d − D v − W3 Ω_w. D11 is not 0 where W1(∞)
    is not. Raises ValueError for a plant with direct feedthrough.
    """
    if not plant.is_strictly_proper:
        raise ValueError(f"plant: {plant.zeros.size} zeros and {plant.order} poles; allowed: fewer zeros than poles")
    g, w1, w2, w3 = (realise_transfer(part) for part in (plant, weights.tracking, weights.command, weights.disturbance))
    zeros_g, zeros_2, zeros_3 = np.zeros(g.b.size), np.zeros(w2.b.size), np.zeros(w3.b.size)
    error = np.concatenate([-g.c, 0 * w1.b, zeros_2, -w3.c])  # e without x_d and without the direct part of W3
    a = block_diagonal([g.a, w1.a, w2.a, w3.a])
    a[g.b.size : g.b.size + w1.b.size] += np.outer(w1.b, error)
    b1 = np.column_stack([
        np.concatenate([zeros_g, w1.b, zeros_2, zeros_3]),
        np.concatenate([zeros_g, -w3.d * w1.b, zeros_2, w3.b]),
    ])  # fmt: skip
    b2 = np.concatenate([g.b, 0 * w1.b, w2.b, zeros_3])[:, None]
    o1 = w1.d * error + np.concatenate([zeros_g, w1.c, zeros_2, zeros_3])
    o2 = np.concatenate([zeros_g, 0 * w1.c, w2.c, zeros_3])
    direct = np.array([[1.0, -w3.d]])
    return GeneralisedPlant(
        a, b1, b2, np.vstack([o1, o2]), error[None, :],
        np.vstack([w1.d * direct, 0 * direct]), np.array([[0.0], [w2.d]]), direct, np.zeros((1, 1)),
    )  # fmt: skip

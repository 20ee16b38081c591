"""Random generalised plants, and H-infinity norms computed without rtloop."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from rtloop.design.synthesis.hinf.augment import GeneralisedPlant


def random_plant(seed: int) -> GeneralisedPlant:
    """Return a plant: order 2 to 20, 1 or 2 commands and measurements, D11, D22 not 0, about 1 mode in 7 unstable."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 21))
    m2, p2 = (int(v) for v in rng.integers(1, 3, 2))
    m1, p1 = p2 + int(rng.integers(0, 3)), m2 + int(rng.integers(0, 3))
    parts = []
    while (remaining_order := n - sum(part.shape[0] for part in parts)) > 0:
        w, sign = 10 ** rng.uniform(0, 3), -1 if rng.random() < 0.85 else 1
        if remaining_order >= 2 and rng.random() < 0.6:
            damping = sign * 10 ** rng.uniform(-2, 0) * w
            parts.append(np.array([[damping, -w], [w, damping]]))
        else:
            parts.append(np.array([[sign * w]]))
    a = linalg.block_diag(*parts)
    size = np.sqrt(np.abs(np.diag(a)) + 1)
    draw = rng.standard_normal
    return GeneralisedPlant(
        a, size[:, None] * draw((n, m1)), size[:, None] * draw((n, m2)), draw((p1, n)) * size, draw((p2, n)) * size,
        0.5 * draw((p1, m1)), draw((p1, m2)), draw((p2, m1)), 0.3 * draw((p2, m2)),
    )  # fmt: skip


def dense_norm(a, b, c, d) -> float:
    """Return max σ̄ on a dense grid, refined around its highest points by finer grids; no Hamiltonian is involved."""
    poles = np.linalg.eigvals(a)
    assert np.all(poles.real < 0)
    sizes = np.abs(poles)
    near_poles = [abs(p.imag) + np.abs(p.real) * np.tan(np.linspace(-1.5, 1.5, 21)) for p in poles]
    grid = np.concatenate([[0.0], np.geomspace(1e-3 * sizes.min(), 1e3 * sizes.max(), 800), *near_poles])
    omega = np.unique(np.abs(grid))
    gains = _gains(a, b, c, d, omega)
    largest = gains.max()
    for i in np.argsort(gains)[-10:]:
        low, high = omega[max(i - 1, 0)], omega[min(i + 1, omega.size - 1)]
        for _ in range(5):
            fine = np.linspace(low, high, 21)
            values = _gains(a, b, c, d, fine)
            j = int(np.argmax(values))
            low, high = fine[max(j - 1, 0)], fine[min(j + 1, 20)]
            largest = max(largest, values[j])
    return float(max(largest, np.linalg.norm(d, 2)))


def _gains(a, b, c, d, omega):
    """Return the largest singular value at each frequency `omega` (rad/s)."""
    pencil = 1j * omega[:, None, None] * np.eye(a.shape[0]) - a
    inputs = np.broadcast_to(b.astype(complex), (omega.size, *b.shape))
    return np.linalg.norm(d + c @ np.linalg.solve(pencil, inputs), 2, axis=(1, 2))


def hamiltonian_norm(a, b, c, d) -> float:
    """Return the norm by bisection: γ exceeds it if the Hamiltonian matrix has no eigenvalue on the imaginary axis."""
    low, high = np.linalg.norm(d, 2) + 1e-9, 1e7
    for _ in range(60):
        gamma = np.sqrt(low * high)
        r = np.linalg.inv(gamma**2 * np.eye(b.shape[1]) - d.T @ d)
        f = a + b @ r @ d.T @ c
        h = np.block([[f, b @ r @ b.T], [-c.T @ (np.eye(c.shape[0]) + d @ r @ d.T) @ c, -f.T]])
        values = np.linalg.eigvals(h)
        crosses = np.any(np.abs(values.real) < 1e-7 * np.abs(values))
        low, high = (gamma, high) if crosses else (low, gamma)
    return float(high)

"""Real, well-conditioned state spaces from zeros, poles and gain, in s or in z alike.

A system with separate poles becomes a sum of modes: block-diagonal, each pole with full precision. If poles repeat or
cluster, the residues of such a sum grow without bound and cancel; the system then becomes a cascade of sections of
first and second order. It is upper quasi-triangular, with each section's poles in its own diagonal block.
"""

from __future__ import annotations

from itertools import accumulate, repeat
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex, Real
from rtloop.foundation.modal import ModalSystem, RepeatedPoles, modal_sum

MAX_CANCELLATION = 1e4
"""Largest ratio of a modal sum's terms to the sum, at any point: it loses four of sixteen digits. Beyond: cascade."""

CHUNK_SAMPLES = 64
"""Number of samples whose states are computed at once."""

Form = Literal["modal", "cascade"]


class System(NamedTuple):
    """State space x' = A x + b u, y = c·x + d u (or x⁺ for x'): `a` (n, n), `b` (n,), `c` (n,), scalar `d`."""

    a: Real
    b: Real
    c: Real
    d: float

    def response(self, complex_points: npt.ArrayLike) -> Complex:
        """Return d + c (xI − A)⁻¹ b at complex points (k,), shape (k,). Raises LinAlgError at an eigenvalue of A."""
        return self.d + self.states(complex_points) @ self.c

    def states(self, complex_points: npt.ArrayLike) -> Complex:
        """Return (xI − A)⁻¹ b at complex points (k,), shape (k, n). Raises LinAlgError at an eigenvalue of A."""
        points = np.atleast_1d(np.asarray(complex_points, dtype=complex))
        pencil = points[:, None, None] * np.eye(self.b.size) - self.a
        inputs = np.broadcast_to(self.b[:, None].astype(complex), (points.size, self.b.size, 1))
        return np.asarray(np.linalg.solve(pencil, inputs)[..., 0], dtype=complex)

    def simulate_states(self, inputs: Real) -> Real:
        """Return the states x_k of x⁺ = A x + b u, (samples, n), from x_0 = 0, for inputs (samples,); in chunks:

        x_k+m = A^m x_k + Σ_j A^(m−1−j) b u_k+j.
        """
        order = self.b.size
        powers = np.array(list(accumulate(repeat(self.a, CHUNK_SAMPLES), np.matmul, initial=np.eye(order))))
        ages = np.subtract.outer(np.arange(CHUNK_SAMPLES), np.arange(CHUNK_SAMPLES))
        answers = np.where(ages[..., None] >= 0, (powers[:-1] @ self.b)[ages], 0.0)
        chunks = np.append(inputs, np.zeros(-inputs.size % CHUNK_SAMPLES)).reshape(-1, CHUNK_SAMPLES)
        chunk_states = np.einsum("sj,mjn->smn", chunks, answers, optimize=True)
        last_state = np.zeros(order)
        for chunk in chunk_states:
            chunk += powers[1:] @ last_state
            last_state = chunk[-1]
        return np.vstack([np.zeros(order), chunk_states.reshape(chunks.size, order)])[: inputs.size]


def realise(zeros: Complex, poles: Complex, gain: float, points: Complex) -> tuple[System, Form]:
    """Return a scaled real realisation and its form: "modal" where `well_conditioned_sum` has a sum, else "cascade".

    In `zeros` (m,) and `poles` (n,), m ≤ n, each complex root is next to its conjugate. `points` (k,) are the complex
    points at which cancellation and the scale of the states are judged.
    """
    modal = well_conditioned_sum(zeros, poles, gain, points)
    if modal is None:
        return scale_states(cascade(zeros, poles, gain), points), "cascade"
    return scale_states(modal_realisation(modal), points), "modal"


def well_conditioned_sum(zeros: Complex, poles: Complex, gain: float, points: Complex) -> ModalSystem | None:
    """Return the sum of modes of gain·Π(x − z)/Π(x − p); None if poles repeat, or if at one of `points` (k,) its terms
    exceed the sum by more than MAX_CANCELLATION.
    """
    try:
        modal = modal_sum(zeros, poles, gain)
    except RepeatedPoles:
        return None
    terms = np.abs(modal.residues / (points[:, None] - modal.poles)).sum(axis=1) + np.abs(modal.direct)
    return modal if np.all(terms <= MAX_CANCELLATION * np.abs(modal.response(points)[0])) else None


def modal_realisation(modal: ModalSystem) -> System:
    """Return the block-diagonal realisation of a sum of modes, of its first output alone."""
    a, b, c, d = modal.realise()
    return System(a, b, c[0], float(d[0]))


def cascade(zeros: Complex, poles: Complex, gain: float) -> System:
    """Return gain·Π(x − z)/Π(x − p) as sections in series, with an upper quasi-triangular A.

    The first section has the last states. The poles of largest real part come last in the series: integrators have the
    first states. Each complex root must be next to its conjugate.
    """
    total = System(np.empty((0, 0)), np.empty(0), np.empty(0), 1.0)
    for group, section_zeros in _sections(zeros, poles):
        section = _section(section_zeros, group)
        a = np.block([[section.a, np.outer(section.b, total.c)], [np.zeros((total.b.size, group.size)), total.a]])
        b = np.concatenate([section.b * total.d, total.b])
        total = System(a, b, np.concatenate([section.c, section.d * total.c]), section.d * total.d)
    return System(total.a, total.b, gain * total.c, gain * total.d)


def _section(zeros: Complex, poles: Complex) -> System:
    """Return a section with one or two poles and at most as many zeros; the leading coefficients are 1.

    The numerator is expanded about the poles, not about 0.
    """
    if poles.size == 1:
        p = poles[0].real
        residue, direct = (p - zeros[0].real, 1.0) if zeros.size else (1.0, 0.0)
        return System(np.array([[p]]), np.ones(1), np.array([residue]), direct)
    first, second = poles
    centre, lag = second.real, first.imag**2
    if first.imag:  # The second state follows the first: b = (1, 0), and `step` is the coupling.
        step = max(abs(first.imag), 1e-4 * abs(first))  # An even rotation, unless the pair is almost a double pole.
        a = np.array([[centre, -lag / step], [step, centre]])
    else:
        step = 1.0
        a = np.array([[centre, step], [0.0, first.real]])
    value = np.prod(centre - zeros).real  # the numerator at the centre
    if zeros.size == 2:
        linear, constant, direct = first.real + centre - zeros.sum().real, value - lag, 1.0
    else:
        linear, constant, direct = float(zeros.size), value, 0.0
    b = np.array([1.0, 0.0]) if first.imag else np.array([0.0, 1.0])
    c = [linear, constant / step]
    return System(a, b, np.array(c if first.imag else c[::-1]), direct)


def _sections(zeros: Complex, poles: Complex) -> list[tuple[Complex, Complex]]:
    """Return (poles, zeros) of each section, in rising order of the largest real part of its poles.

    A pair of zeros joins the nearest free pair of poles; a single zero joins the single pole or, without one, the
    nearest free pair. The other poles have no zeros. Each complex root must be next to its conjugate, and there must be
    no more zeros than poles.
    """
    pole_groups, zero_groups = _root_pairs(poles), _root_pairs(zeros)
    sections: list[tuple[Complex, Complex]] = []
    for section_zeros in zero_groups:
        fitting = [g for g in pole_groups if g.size == section_zeros.size] or pole_groups
        nearest = min(
            fitting, key=lambda group, section_zeros=section_zeros: float(np.abs(group[:, None] - section_zeros).min())
        )
        pole_groups = [g for g in pole_groups if g is not nearest]
        sections.append((nearest, section_zeros))
    sections += [(group, np.empty(0, dtype=complex)) for group in pole_groups]
    return sorted(sections, key=lambda section: float(section[0].real.max()))


def _root_pairs(roots: Complex) -> list[Complex]:
    """Return `roots` (n,) in groups with real coefficients: pairs (2,), then a single real root (1,).

    A pair is two conjugates, which stand side by side in `roots`, or two successive real roots.
    """
    reals, pairs = roots[roots.imag == 0], roots[roots.imag != 0]
    groups = [pairs[i : i + 2] for i in range(0, pairs.size, 2)] + [reals[i : i + 2] for i in range(0, reals.size, 2)]
    return sorted(groups, key=lambda group: -group.size)


def scale_states(system: System, points: Complex) -> System:
    """Return the system with states scaled so that each block's largest response over `points` (k,) is about 1.

    The factors are powers of two, which cause no rounding, and equal within a block, which keeps rotations.
    """
    size = np.ones(system.b.size)
    responses = np.abs(system.states(points))
    for block in blocks(system.a):
        peak = float(responses[:, block].max(initial=0.0))
        if peak > 0 and np.isfinite(peak):
            size[block] = 2.0 ** np.round(np.log2(peak))
    return System(system.a * size / size[:, None], system.b / size, system.c * size, system.d)


def blocks(a: Real) -> list[slice]:
    """Return the diagonal blocks (1×1 and 2×2) of an upper quasi-triangular matrix, as slices of its rows."""
    slices: list[slice] = []
    row = 0
    while row < a.shape[0]:
        width = 2 if row + 1 < a.shape[0] and a[row + 1, row] != 0 else 1
        slices.append(slice(row, row + width))
        row += width
    return slices


def row_bands(a: Real) -> npt.NDArray[np.int64]:
    """Return the first and past-the-last nonzero column of each row, shape (n, 2); (0, 0) for a row of zeros."""
    bands = np.zeros((a.shape[0], 2), dtype=np.int64)
    for row, values in enumerate(a):
        columns = np.flatnonzero(values)
        if columns.size:
            bands[row] = columns[0], columns[-1] + 1
    return bands


def imaginary_axis_points(roots: Complex) -> Complex:
    """Return 401 points, from a tenth of the smallest to ten times the largest of `roots` (rad/s), right of s = jω.

    The points rise in a constant ratio. On the axis itself, a point could hit an undamped root. Roots at 0 do not
    count; without others, the scale is 1 rad/s.
    """
    sizes = np.abs(roots[roots != 0]) if np.any(roots != 0) else np.ones(1)
    return (0.01 + 1j) * np.geomspace(0.1 * sizes.min(), 10 * sizes.max(), 401)


def unit_circle_points() -> Complex:
    """Return 401 points just outside |z| = 1, from 1e-6 to 0.9 of half the sampling rate, in a constant ratio.

    They end before z = −1, where zeros dominate.
    """
    return np.exp((0.01 + 1j) * np.pi * np.geomspace(1e-6, 0.9, 401))

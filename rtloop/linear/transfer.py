"""Transfer functions of one input and one output, kept as zeros, poles and gain.

    G(s) = gain · Π(s − zᵢ) / Π(s − pᵢ),    s in rad/s

Products of factors are never expanded: the coefficients of eq (5) of the paper, with its eight poles, would span 43
powers of ten. Every form of input is converted to factors once, and all later computation uses the factors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex
from rtloop.foundation.modal import conjugate_pairs, quadratic_roots
from rtloop.linear.realisation import System
from rtloop.linear.zeros import factored_response, zeros_and_gain

MAX_ORDER = 200
"""Largest order: far above the order of controllers that run, and roots still take only milliseconds."""


@dataclass(frozen=True, eq=False)
class Transfer:
    """A proper real transfer function: `zeros` (m,), `poles` (n,), m ≤ n, in rad/s, and `gain`.

    Roots are sorted: the real ones, ascending, then pairs of exact conjugates, the upper one first. Raises ValueError
    for more zeros than poles, an order above MAX_ORDER, a value that is not finite, and a complex root without its
    conjugate.
    """

    zeros: Complex
    poles: Complex
    gain: float

    def __post_init__(self) -> None:
        """Sort the roots, make conjugates exact and arrays read-only. Raises ValueError for the cases that the class
        names.
        """
        require_order(max(np.size(self.zeros), np.size(self.poles)))
        object.__setattr__(self, "zeros", _conjugate_roots("zeros", self.zeros))
        object.__setattr__(self, "poles", _conjugate_roots("poles", self.poles))
        object.__setattr__(self, "gain", float(_finite("gain", self.gain)))
        if self.zeros.size > self.poles.size:
            raise ValueError(
                f"improper: {self.zeros.size} zeros and {self.poles.size} poles; allowed: up to as many zeros as poles"
            )

    @classmethod
    def from_zpk(cls, zeros: npt.ArrayLike, poles: npt.ArrayLike, gain: float) -> Transfer:
        """Return gain · Π(s − zᵢ)/Π(s − pᵢ) for zeros and poles in rad/s. Raises ValueError like the class."""
        return cls(np.asarray(zeros, dtype=complex), np.asarray(poles, dtype=complex), gain)

    @classmethod
    def from_factors(
        cls, gain: float, numerator: Sequence[npt.ArrayLike] = (), denominator: Sequence[npt.ArrayLike] = ()
    ) -> Transfer:
        """Return gain times a quotient of products of real polynomials in s, each with its highest power first.

        An empty product is 1, and a zero factor of the numerator gives G = 0. Raises ValueError for a coefficient that
        is not finite, a zero factor of the denominator, more zeros than poles, and an order above MAX_ORDER.
        """
        zeros, numerator_gain = _product("numerator", numerator)
        poles, denominator_gain = _product("denominator", denominator)
        return cls(zeros, poles, float(_finite("gain", gain)) * numerator_gain / denominator_gain)

    @classmethod
    def from_transfer_function(cls, numerator: npt.ArrayLike, denominator: npt.ArrayLike) -> Transfer:
        """Return the quotient of two real polynomials in s, highest power first; `from_factors` is more accurate.

        Raises ValueError for a coefficient that is not finite, a zero denominator, more zeros than poles, and an order
        above MAX_ORDER.
        """
        return cls.from_factors(1.0, [numerator], [denominator])

    @classmethod
    def from_state_space(cls, a: npt.ArrayLike, b: npt.ArrayLike, c: npt.ArrayLike, d: npt.ArrayLike) -> Transfer:
        """Return the transfer function of x' = A x + B u, y = C x + D u: `a` (n, n), `b` and `c` n values, `d` one.

        All n poles stay, also poles that zeros cancel; a system that is zero becomes gain 0 without roots. Raises
        ValueError for shapes that do not fit, values that are not finite, and an order above MAX_ORDER.
        """
        system = _system(a, b, c, d)
        zeros, gain = zeros_and_gain(system)
        return cls(zeros, _eigenvalues(system.a), gain) if gain else cls.from_zpk([], [], 0.0)

    def __mul__(self, other: Transfer) -> Transfer:
        """Return the series connection of both. Common factors are not cancelled.

        Raises ValueError for an order above MAX_ORDER.
        """
        zeros, poles = np.concatenate([self.zeros, other.zeros]), np.concatenate([self.poles, other.poles])
        return Transfer(zeros, poles, self.gain * other.gain)

    def response(self, s: npt.ArrayLike) -> Complex:
        """Return G, complex, at points `s` in rad/s, in the shape of `s`; not finite at a pole."""
        return factored_response(self.zeros, self.poles, self.gain, s)

    @property
    def order(self) -> int:
        """Number of poles of the transfer function."""
        return self.poles.size

    @property
    def dc_gain(self) -> float:
        """G(0); +inf with an integrator, whatever the sign, 0 with a differentiator.

        Equal numbers of zeros and poles at 0 cancel.
        """
        surplus = int(np.sum(self.poles == 0)) - int(np.sum(self.zeros == 0))
        if surplus > 0:
            return math.inf
        if surplus < 0:
            return 0.0
        return float(factored_response(self.zeros[self.zeros != 0], self.poles[self.poles != 0], self.gain, 0.0).real)

    @property
    def high_frequency_gain(self) -> float:
        """G(∞), the direct feedthrough."""
        return 0.0 if self.is_strictly_proper else self.gain

    @property
    def is_stable(self) -> bool:
        """Whether all poles are to the left of the imaginary axis."""
        return bool(np.all(self.poles.real < 0))

    @property
    def is_strictly_proper(self) -> bool:
        """Whether there are fewer zeros than poles, and so no direct feedthrough."""
        return self.zeros.size < self.poles.size


def require_order(order: int) -> None:
    """Raise ValueError for an order above MAX_ORDER, whose roots would take seconds."""
    if order > MAX_ORDER:
        raise ValueError(f"transfer function: order {order}; allowed: up to {MAX_ORDER}")


def _finite(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return `values` as floats. Raises ValueError, naming `name`, unless all are finite real numbers."""
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: {values!r} is not real; allowed: finite real numbers") from None
    if not np.all(np.isfinite(numbers)):
        raise ValueError(f"{name}: {values!r} is not finite; allowed: finite numbers")
    return numbers


def _conjugate_roots(name: str, roots: Complex) -> Complex:
    """Return `roots` as a read-only array of exact conjugate pairs and real roots, sorted by `conjugate_pairs`.

    Raises ValueError, naming `name`, for a root that is not finite and for a complex root without its conjugate, with
    the tolerance of `conjugate_pairs`.
    """
    values = np.atleast_1d(np.asarray(roots, dtype=complex))
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: {values.tolist()} is not finite; allowed: finite numbers")
    try:
        paired = conjugate_pairs(values)
    except ValueError as fault:
        raise ValueError(f"{name}: {fault}; allowed: complex {name} in conjugate pairs only") from None
    paired.flags.writeable = False
    return paired


def _product(name: str, factors: Sequence[npt.ArrayLike]) -> tuple[Complex, float]:
    """Return roots (n,) and leading coefficient of a product of polynomials, each with its highest power first.

    `name` is "numerator" or "denominator". A zero factor of a numerator gives no roots and 0.0. Raises ValueError for a
    factor that is no list of finite numbers, an order above MAX_ORDER, and a zero factor of a denominator.
    """
    roots: list[Complex] = [np.empty(0, dtype=complex)]
    leading = 1.0
    require_order(len(factors))
    for factor in factors:
        require_order(np.size(factor) - 1)
        polynomial = np.trim_zeros(np.atleast_1d(_finite(name, factor)), "f")
        if polynomial.ndim != 1:
            raise ValueError(f"{name}: {factor!r}; allowed: a list of coefficients, highest power of s first")
        if not polynomial.size:
            if name == "denominator":
                raise ValueError(f"{name}: {factor!r} is zero; allowed: at least one coefficient other than 0")
            return np.empty(0, dtype=complex), 0.0
        roots.append(_roots(polynomial))
        leading *= float(polynomial[0])
    return np.concatenate(roots), leading


def _roots(polynomial: npt.NDArray[np.float64]) -> Complex:
    """Return the roots (n,) of a polynomial, highest power first.

    The roots of a quadratic come from the closed form, which keeps a double root exactly double.
    """
    if polynomial.size != 3:
        return np.roots(polynomial).astype(complex)
    return np.array(quadratic_roots(*(polynomial[1:] / polynomial[0])), dtype=complex)


def _system(a: npt.ArrayLike, b: npt.ArrayLike, c: npt.ArrayLike, d: npt.ArrayLike) -> System:
    """Return a state space with one input and one output of `a` (n, n), `b` and `c` (n values), `d` (one).

    Raises ValueError, naming a matrix, if it is not real and finite or its shape does not fit; and for an order above
    MAX_ORDER.
    """
    require_order(np.shape(a)[0] if np.size(a) else 0)
    matrix = np.atleast_2d(_finite("a", a)) if np.size(a) else np.empty((0, 0))
    column, row, direct = _finite("b", b).ravel(), _finite("c", c).ravel(), _finite("d", d).ravel()
    order = matrix.shape[0]
    for name, shape, allowed in (
        ("a", matrix.shape, (order, order)),
        ("b", column.shape, (order,)),
        ("c", row.shape, (order,)),
        ("d", direct.shape, (1,)),
    ):
        if shape != allowed:
            raise ValueError(
                f"{name}: an array of {' × '.join(map(str, shape))}; allowed: {' × '.join(map(str, allowed))}, for "
                "one input and one output"
            )
    return System(matrix, column, row, float(direct[0]))


def _eigenvalues(a: npt.NDArray[np.float64]) -> Complex:
    """Return the eigenvalues (n,); an eigenvalue within rounding of 0 becomes 0, which keeps an integrator exact."""
    values = np.linalg.eigvals(a).astype(complex)
    values[np.abs(values) <= a.shape[0] * np.finfo(float).eps * np.linalg.norm(a)] = 0.0
    return values

"""A linear controller given by its matrices, for the analysis of a loop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rtloop.foundation.arrays import Complex
from rtloop.linear.coupled_systems import CoupledSystem
from rtloop.linear.realisation import System
from rtloop.linear.zeros import zeros_and_gain

AT_ONE = 1e-9
"""Distance from z = 1 below which a pole counts as an integrator."""


@dataclass(frozen=True, eq=False)
class SampledController:
    """Linear controller x⁺ = A x + b e, v = c·x + d e at one period.

    `with_reference` has the reference, at an error of 0, as a second input, and its states; None for a law that uses
    the error alone. `reference_fault` is the reason why the command is not linear in the reference, else "".
    """

    system: System
    period_s: float
    with_reference: CoupledSystem | None = None
    reference_fault: str = ""

    @property
    def order(self) -> int:
        """Number of states of the controller."""
        return self.system.b.size

    @cached_property
    def zeros(self) -> Complex:
        """Finite zeros (m,) of C(z)."""
        return zeros_and_gain(self.system)[0]

    @cached_property
    def poles(self) -> Complex:
        """Poles (n,) of C(z), the eigenvalues of A."""
        return np.linalg.eigvals(self.system.a).astype(complex) if self.order else np.empty(0, complex)

    @cached_property
    def dc_gain(self) -> float:
        """C(z = 1); +inf, whatever the sign, if a pole is closer than AT_ONE to 1."""
        if np.any(np.abs(self.poles - 1) < AT_ONE):
            return math.inf
        return float(self.system.response(1.0)[0].real)

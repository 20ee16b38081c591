"""Several axes closed by one controller, on a plant whose axes move each other, sample by sample.

    r ──(+)── e ──► C(z) ──► v ──► K ──► (delay) ──► D_i ──┬──► x       L = G C,  G = diag(D_i) K
          ▲ −                                              │            S = (I + L)⁻¹
          └────────────────────────────────────────────────┘

Margins of one axis are the margins of its loop broken alone, with all others closed. For changes in several axes at
once, the largest singular value of S and the disk margin count (Skogestad and Postlethwaite, Multivariable Feedback
Control, 2005; Seiler, Packard and Gahinet, An Introduction to Disk Margins, 2020).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.analysis.closed_loop import Injection, LawReference, Loop
from rtloop.analysis.held_plant import HeldPlant, IntersampleOutput, hold_plant
from rtloop.analysis.margins import find_maximum
from rtloop.analysis.reference import UNFILTERED, ReferencePath
from rtloop.foundation.arrays import Complex, Real, rising_grid
from rtloop.linear.coupled_systems import DC_OFFSET, CoupledSystem, SampledCoupledSystem, block_diagonal_system
from rtloop.linear.realisation import System
from rtloop.linear.transfer import Transfer
from rtloop.values import to_jsonable

UNIT_SYSTEM = System(np.empty((0, 0)), np.empty(0), np.empty(0), 1.0)
"""A system that passes a signal unchanged."""
NO_INJECTION = Injection(np.empty(0), np.empty(0))
BALANCINGS = 30
INTEGRATOR_GAIN = 1e6
"""Gain near z = 1 above which a loop counts as integrating."""


@dataclass(frozen=True, eq=False)
class CoupledPlant:
    """D_i(s) and samples of delay of each axis, and the coupling K, (axes, axes)."""

    dynamics: tuple[Transfer, ...]
    delay_ticks: tuple[int, ...]
    coupling: Real

    def replace_axis(self, number: int, dynamics: Transfer, delay_ticks: int) -> CoupledPlant:
        """Return the plant with D(s) and delay, in samples, of axis `number`, from 0, replaced."""
        return replace(
            self,
            dynamics=(*self.dynamics[:number], dynamics, *self.dynamics[number + 1 :]),
            delay_ticks=(*self.delay_ticks[:number], delay_ticks, *self.delay_ticks[number + 1 :]),
        )

    def hold_plants(self, period_s: float) -> list[HeldPlant]:
        """Return each axis's plant with its delay behind a zero-order hold, without the coupling.

        Raises ValueError for a plant with direct feedthrough, a negative delay and a period that is not positive.
        """
        for plant in self.dynamics:
            if not plant.is_strictly_proper:
                raise ValueError(
                    f"plant: {plant.zeros.size} zeros and {plant.order} poles; allowed: fewer zeros than poles "
                    "(no direct feedthrough)"
                )
        pairs = zip(self.dynamics, self.delay_ticks, strict=True)
        return [hold_plant(plant, period_s, ticks) for plant, ticks in pairs]


def coupling_matrix(names: Sequence[str], coupling: Sequence[Mapping[str, float]]) -> Real:
    """Return the coupling K (axes, axes): µm at the input of the row's dynamics per µm of the column's command.

    `coupling` has a dict for each of `names`, in the same order: the factors of its row by the names of the other axes.
    K is 1 on the diagonal, and 0 for axes that the dict does not name; other names in the dict are ignored.
    """
    pairs = zip(names, coupling, strict=True)
    return np.array([[1.0 if a == b else factors.get(b, 0.0) for b in names] for a, factors in pairs])


@dataclass(frozen=True, eq=False)
class BrokenLoop(Loop):
    """The loop of one axis, the other axes closed: `plant` is from error to position, `command` from error to command.

    `command_injection` is the effect of a signal added to the axis's command.
    """

    command: System = UNIT_SYSTEM
    command_injection: Injection = NO_INJECTION

    @property
    def injection(self) -> Injection:
        """Effect of a signal added to the axis's command, other axes closed, on states and positions in a period."""
        return self.command_injection

    def command_sensitivity(self, hz: npt.ArrayLike) -> Real:
        """Return |C·S| (k,) from the reference of the axis's error (without pre-filter) to its command, at frequencies
        (k,) in Hz.
        """
        return np.abs(self.command.response(self._points(hz))) * self.sensitivity(hz)

    @cached_property
    def error_matrices(self) -> tuple[Real, Real, Real, Real]:
        """A (n, n), b (n,), C (2, n), d (2,) from a signal added to the axis's error to position, command."""
        a, b, c, _ = self.plant
        command_row, direct = self.command.c, self.command.d
        return a - np.outer(b, c), b, np.vstack([c, command_row - direct * c]), np.array([0.0, direct])


class SimultaneousMargins(NamedTuple):
    """Largest singular values of S and of T, and disk margins α of all sensors and of all commands at once.

    Every axis's gain may change within a factor (1 − α/2)/(1 + α/2) … (1 + α/2)/(1 − α/2), and its phase by 2
    atan(α/2), all at once and each in another way. NaN where the loop is unstable.
    """

    max_sensitivity: float
    max_sensitivity_hz: float
    max_tracking: float
    disk_margin: float
    disk_margin_hz: float
    command_disk_margin: float
    command_disk_margin_hz: float

    def as_dict(self) -> dict[str, object]:
        """Return the margins by name as values for JSON, null for margins that are not finite."""
        return to_jsonable(self)


class CoupledLoop:
    """The closed loop of C(z) and G(z), with several axes. Raises ValueError like `CoupledPlant.hold_plants`."""

    def __init__(self, controller: SampledCoupledSystem, plant: CoupledPlant) -> None:
        """Close the loop at the period of `controller`. Raises ValueError like `CoupledPlant.hold_plants`."""
        self.period_s = controller.period_s
        self._held, self._coupling = plant.hold_plants(controller.period_s), plant.coupling
        self._controller, self._reference_columns = controller.system, None
        self._reference_fault = controller.reference_fault
        if controller.with_reference is not None:
            a, b, c, d = controller.with_reference
            m = controller.count
            self._controller, self._reference_columns = CoupledSystem(a, b[:, :m], c, d[:, :m]), (b[:, m:], d[:, m:])
        self._plant = block_diagonal_system([plant_of_axis.system for plant_of_axis in self._held]).transform(
            plant.coupling
        )
        self.axis_count = controller.count

    def axis_loop(self, number: int, reference: ReferencePath = UNFILTERED) -> BrokenLoop:
        """Return the loop of axis `number`, from 0, broken at its sensor, the other axes closed.

        `reference` is the axis's pre-filter. The static gain is ±inf if its magnitude exceeds INTEGRATOR_GAIN near
        z = 1.
        """
        ac, bc, cc, dc = self._controller
        ap, bp, cp, _ = self._plant
        closed_axes = np.eye(self.axis_count)
        closed_axes[number, number] = 0.0
        a = np.block([[ap - bp @ dc @ closed_axes @ cp, bp @ cc], [-bc @ closed_axes @ cp, ac]])
        b = np.concatenate([bp @ dc[:, number], bc[:, number]])
        c = np.concatenate([cp[number], np.zeros(ac.shape[0])])
        plant = System(a, b, c, 0.0)
        command = System(a, b, np.concatenate([-dc[number] @ closed_axes @ cp, cc[number]]), float(dc[number, number]))
        poles = np.linalg.eigvals(a).astype(np.complex128)
        rates = np.asarray(np.log(poles[np.abs(poles) > 1e-9]) / self.period_s, np.complex128)
        static_response = float(plant.response(1.0 + DC_OFFSET)[0].real)
        static = static_response if abs(static_response) < INTEGRATOR_GAIN else np.copysign(np.inf, static_response)
        injection = Injection(np.concatenate([bp[:, number], np.zeros(ac.shape[0])]), self._held[number].between.direct)
        between = self._intersample_rows(number, closed_axes)
        return BrokenLoop(
            UNIT_SYSTEM, plant, float(static), rates, self.period_s, between, reference,
            self._law_reference(number), self._reference_fault, command, injection,
        )  # fmt: skip

    def _law_reference(self, number: int) -> LawReference | None:
        """Return the effect of the reference of axis `number` past its error; None for a law that uses errors alone."""
        if self._reference_columns is None:
            return None
        columns, direct = (part[:, number] for part in self._reference_columns)
        moved_um = float(self._coupling[number] @ direct)
        states = np.concatenate([self._plant.b @ direct, columns])
        return LawReference(states, moved_um * self._held[number].between.direct, float(direct[number]))

    def _intersample_rows(self, number: int, closed_axes: Real) -> IntersampleOutput:
        """Return positions of axis `number` within a period, from all states (plants, then controller) and its error.

        `closed_axes` (axes, axes) is 1 on the diagonal for every other axis.
        """
        _, _, cc, dc = self._controller
        rows, direct = self._held[number].between
        states_before = sum(axis_plant.system.b.size for axis_plant in self._held[:number])
        states_after = self._plant.a.shape[0] - states_before - rows.shape[1]
        command_columns = np.outer(direct, self._coupling[number])
        plants = (
            np.pad(rows, ((0, 0), (states_before, states_after))) - command_columns @ dc @ closed_axes @ self._plant.c
        )
        state_rows = np.hstack([plants, command_columns @ cc])
        return IntersampleOutput(
            np.asarray(state_rows, np.float64), np.asarray(command_columns @ dc[:, number], np.float64)
        )

    @cached_property
    def poles(self) -> Complex:
        """Poles in z (n,) of the closed loop of all axes, unsorted."""
        return self.axis_loop(0).poles

    @property
    def is_stable(self) -> bool:
        """Whether every pole lies inside the unit circle."""
        return bool(np.all(np.abs(self.poles) < 1))

    def sensitivity(self, hz: npt.ArrayLike) -> Complex:
        """Return S = (I + G C)⁻¹ at frequencies (k,) in Hz, complex (k, axes, axes): from the column's reference
        (without pre-filter) to the row's error.
        """
        return self._inverse_return_difference(hz, self._plant, self._controller)

    def command_sensitivity(self, hz: npt.ArrayLike) -> Complex:
        """Return (I + C G)⁻¹ at frequencies (k,) in Hz, complex (k, axes, axes): from a signal added to the column's
        command, to the row's command.
        """
        return self._inverse_return_difference(hz, self._controller, self._plant)

    def _inverse_return_difference(self, hz: npt.ArrayLike, first: CoupledSystem, second: CoupledSystem) -> Complex:
        """Return (I + first·second)⁻¹ at frequencies (k,) in Hz, (k, axes, axes)."""
        points = np.exp(2 * np.pi * (1e-12 + 1j) * np.atleast_1d(np.asarray(hz, float)) * self.period_s)
        open_loop = first.response(points) @ second.response(points)
        return np.asarray(np.linalg.inv(np.eye(self.axis_count) + open_loop), np.complex128)

    @cached_property
    def margins(self) -> SimultaneousMargins:
        """Margins for simultaneous changes of all axes, at their worst frequencies; all NaN if the loop is unstable."""
        if not self.is_stable:
            return SimultaneousMargins(*[np.nan] * len(SimultaneousMargins._fields))
        hz = rising_grid([self.axis_loop(i).frequencies for i in range(self.axis_count)])
        identity = np.eye(self.axis_count)
        peak, peak_hz = find_maximum(lambda f: _largest_singular_value(self.sensitivity(f)), hz)
        tracking, _ = find_maximum(lambda f: _largest_singular_value(identity - self.sensitivity(f)), hz)
        disk, disk_hz = find_maximum(lambda f: _structured_singular_value(self.sensitivity(f) - identity / 2), hz)
        command, command_hz = find_maximum(
            lambda f: _structured_singular_value(self.command_sensitivity(f) - identity / 2), hz
        )
        return SimultaneousMargins(peak, peak_hz, tracking, 1 / disk, disk_hz, 1 / command, command_hz)


def _largest_singular_value(matrices: Complex) -> Real:
    """Return the largest singular value of each of (k, m, m), shape (k,)."""
    return np.asarray(np.linalg.svd(matrices, compute_uv=False)[:, 0], np.float64)


def _structured_singular_value(matrices: Complex) -> Real:
    """Return an upper bound (k,) of the structured singular value μ of `matrices` (k, m, m), for one complex change per
    axis (a diagonal); exact for two axes.

    The bound is σ̄ after a scaling that makes, for each axis, the norm of its row equal to the norm of its column, both
    without the diagonal (Osborne, 1960). The Frobenius norm is then least. For two axes the largest singular value is
    least, too, because the product of both singular values does not depend on the scaling. The couplings of an axis
    that only acts on others, or is only acted on, are set to 0: scaling makes them arbitrarily small.
    """
    balanced = matrices.copy()
    axes = np.arange(balanced.shape[1])
    for _ in range(BALANCINGS if axes.size > 2 else 1):
        for i in axes:
            is_other_axis = axes != i
            row = np.linalg.norm(balanced[:, i, is_other_axis], axis=1)
            column = np.linalg.norm(balanced[:, is_other_axis, i], axis=1)
            is_coupled = (row > 0) & (column > 0)
            balanced[:, i, is_other_axis] *= is_coupled[:, None]
            balanced[:, is_other_axis, i] *= is_coupled[:, None]
            scale = np.sqrt(np.where(is_coupled, column, 1.0) / np.where(is_coupled, row, 1.0))
            balanced[:, i, :] *= scale[:, None]
            balanced[:, :, i] /= scale[:, None]
    return _largest_singular_value(balanced)

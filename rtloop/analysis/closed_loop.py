"""Controller and plant joined into one loop, in continuous time or sample by sample.

    r ──(+)── e ──► C ──► v ──► (delay) ──► D ──┬──► x          L = C·D,   S = 1/(1 + L)
          ▲ −                                   │
          └─────────────────────────────────────┘

The plant has no direct feedthrough, so there is no algebraic loop, and in discrete time the sample that a computed
command needs to show in x is in the plant already: `delay_ticks` counts what comes on top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.analysis.held_plant import IntersampleOutput, hold_plant
from rtloop.analysis.reference import UNFILTERED, ReferencePath
from rtloop.foundation.arrays import Complex, Real, rising_grid
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.realisation import System, imaginary_axis_points, realise
from rtloop.linear.sampled import SampledController
from rtloop.linear.transfer import Transfer

REFERENCE_NOT_LINEAR = "not linear in the reference"
"""Fault of a law for which no step can be computed, in messages."""


class Injection(NamedTuple):
    """Effect of a signal added to the command: `b` (n,) on the loop's states, `between` on the positions of a period.

    `between` is (POINTS,), or (1,) where only the samples are known.
    """

    b: Real
    between: Real


class LawReference(NamedTuple):
    """Effect of the reference past the error, by the law's own use of it: `b` (n,) on the loop's states, `between` on
    the positions of a period, `command` on the command.
    """

    b: Real
    between: Real
    command: float


@dataclass(frozen=True, eq=False)
class Loop:
    """C and D as state spaces; `period_s` is None in continuous time. `static_gain` is L at 0 Hz, ±inf if it
    integrates.

    `roots` (k,), in rad/s, are zeros and poles of C and D, near which `frequencies` is dense. `between` is D's position
    within a period, from its states and its input; None in continuous time, and where only the samples are known.
    `reference` is the pre-filter. `law_reference` is None for a law that uses the error alone. If `reference_fault` is
    not "", the law is not linear in the reference, for this reason: the response to the reference is not known.
    """

    controller: System
    plant: System
    static_gain: float
    roots: Complex
    period_s: float | None = None
    between: IntersampleOutput | None = None
    reference: ReferencePath = UNFILTERED
    law_reference: LawReference | None = None
    reference_fault: str = ""

    def open(self, hz: npt.ArrayLike) -> Complex:
        """Return L = C·D at frequencies (k,) in Hz, complex (k,): controller C and plant D, in discrete time D with its
        hold and delay.
        """
        points = self._points(hz)
        return self.controller.response(points) * self.plant.response(points)

    def _points(self, hz: npt.ArrayLike) -> Complex:
        """Return frequencies (k,) in Hz as points slightly right of s = j2πf, or of z = exp(j2πfT)."""
        beside_axis = 1e-12 + 1j  # an undamped root on the axis itself has no response
        points = 2 * np.pi * beside_axis * np.atleast_1d(np.asarray(hz, dtype=float))
        return points if self.period_s is None else np.exp(points * self.period_s)

    def sensitivity(self, hz: npt.ArrayLike) -> Real:
        """Return |S| = 1/|1 + L| (k,) at frequencies (k,) in Hz."""
        return 1.0 / np.abs(1.0 + self.open(hz))

    def command_sensitivity(self, hz: npt.ArrayLike) -> Real:
        """Return the magnitude of the response |C·S| (k,), from the error's reference (without pre-filter) to the
        command, at frequencies (k,) in Hz.
        """
        return np.abs(self.controller.response(self._points(hz))) * self.sensitivity(hz)

    def response_from_command(self, hz: npt.ArrayLike) -> Complex:
        """Return the complex response (k,) from a signal added to the command to the position, at frequencies (k,) in
        Hz.

        In discrete time, the signal passes hold and delay.
        """
        a, _, c, _ = self.matrices
        return System(a, self.injection.b, c[0], 0.0).response(self._points(hz))

    @cached_property
    def matrices(self) -> tuple[Real, Real, Real, Real]:
        """A (n, n), b (n,), C (2, n), d (2,) from the law's reference (behind the pre-filter) to position x and command
        v.
        """
        a, b, c, d = self.error_matrices
        if self.law_reference is None:
            return a, b, c, d
        return a, b + self.law_reference.b, c, d + np.array([0.0, self.law_reference.command])

    @cached_property
    def error_matrices(self) -> tuple[Real, Real, Real, Real]:
        """`matrices` from a signal added to the error alone, such as a negative disturbance of the reading.

        The controller's states come first, then the plant's.
        """
        ac, bc, cc, dc = self.controller
        ap, bp, cp, _ = self.plant
        a = np.block([[ac, -np.outer(bc, cp)], [np.outer(bp, cc), ap - dc * np.outer(bp, cp)]])
        c = np.vstack([np.concatenate([0 * cc, cp]), np.concatenate([cc, -dc * cp])])
        return a, np.concatenate([bc, dc * bp]), c, np.array([0.0, dc])

    @cached_property
    def positions(self) -> IntersampleOutput:
        """Positions at the POINTS instants of a period, the sample first, from the closed loop's states and the law's
        reference.

        If `between` is None, these are the position at the sample alone: (1, n) and (1,).
        """
        rows, direct = self._error_positions
        return IntersampleOutput(rows, direct if self.law_reference is None else direct + self.law_reference.between)

    @property
    def _error_positions(self) -> IntersampleOutput:
        """`positions` from a signal added to the error alone."""
        _, _, c, d = self.error_matrices
        if self.between is None:
            return IntersampleOutput(c[:1], d[:1])
        _, _, cc, dc = self.controller
        rows, direct = self.between
        return IntersampleOutput(
            np.hstack([np.outer(direct, cc), rows - dc * np.outer(direct, self.plant.c)]), dc * direct
        )

    @property
    def injection(self) -> Injection:
        """Effect of a signal added to the command on the closed loop's states and, directly, on the positions of a
        period.
        """
        between = np.zeros(1) if self.between is None else self.between.direct
        return Injection(np.concatenate([np.zeros(self.controller.b.size), self.plant.b]), between)

    @cached_property
    def final_values(self) -> tuple[float, float]:
        """Final (position, command) after a unit step of the reference, pre-filter included.

        Only a stable loop reaches these values. Raises LinAlgError for a closed-loop pole at s = 0, or z = 1.
        """
        a, b, c, d = self.matrices
        toward_error, toward_command = (float(gain[0].real) for gain in self.reference.response(1.0))
        inputs = toward_error * b + toward_command * self.injection.b
        states = np.linalg.solve(-a if self.period_s is None else np.eye(b.size) - a, inputs)
        position, command = c @ states + toward_error * d
        return float(position), float(command) + toward_command

    def response_from_reference(self, hz: npt.ArrayLike) -> tuple[Complex, Complex]:
        """Return the complex responses (k,) from the reference to (position, command), at frequencies (k,) in Hz.

        The pre-filter is included.
        """
        a, b, c, d = self.matrices
        points = self._points(hz)
        toward_error, toward_command = self.reference.response(points)
        position, command = (toward_error * System(a, b, c[i], float(d[i])).response(points) for i in (0, 1))
        if self.reference.has_command_path:
            position = position + toward_command * self.response_from_command(hz)
            command = command + toward_command * System(a, self.injection.b, c[1], 1.0).response(points)
        return position, command

    @cached_property
    def poles(self) -> Complex:
        """Closed-loop poles (n,), in s (rad/s) or in z, unsorted; those of the pre-filter are not included."""
        return np.linalg.eigvals(self.matrices[0]).astype(complex)

    @property
    def is_stable(self) -> bool:
        """Whether every pole lies left of the imaginary axis, or inside the unit circle."""
        is_decaying = self.poles.real < 0 if self.period_s is None else np.abs(self.poles) < 1
        return bool(np.all(is_decaying))

    @cached_property
    def rates(self) -> Complex:
        """Closed-loop poles as rates in s (rad/s): the poles themselves, or log(z)/T without those at |z| ≤ 1e-9."""
        if self.period_s is None:
            return self.poles
        return _rates(self.poles, self.period_s)

    @cached_property
    def frequencies(self) -> Real:
        """A rising grid in Hz, above 0, even on a logarithmic scale, and dense near lightly damped roots of C, D and
        the closed loop.

        It ends at half the sampling rate, in continuous time at ten times the largest root.
        """
        roots = np.concatenate([self.roots, self.rates])
        sizes = np.abs(roots[roots != 0]) / (2 * math.pi)
        lowest, highest = (sizes.min(), sizes.max()) if sizes.size else (1.0, 1.0)
        top = 10 * highest if self.period_s is None else 0.5 / self.period_s
        grids = [np.geomspace(min(0.01 * lowest, 1e-3 * top), top, 1500)]
        offsets = np.tan(np.linspace(-1.5, 1.5, 60))
        upper = roots[roots.imag > 0]
        widths = np.maximum(np.abs(upper.real), 1e-6 * np.abs(upper))
        grids += [np.abs(upper.imag[:, None] + np.outer(widths, offsets)).ravel() / (2 * math.pi)]
        hz = rising_grid(grids)
        return hz[(hz > 0) & (hz <= top)]


def continuous_loop(controller: Transfer, plant: Transfer) -> Loop:
    """Return the loop of C(s) and D(s) in continuous time, without delay and pre-filter.

    Raises ValueError for a plant with direct feedthrough.
    """
    _require_strictly_proper(plant)
    roots = np.concatenate([controller.zeros, controller.poles, plant.zeros, plant.poles])
    return Loop(realise_transfer(controller), realise_transfer(plant), (controller * plant).dc_gain, roots)


def discrete_loop(
    controller: DiscreteController | SampledController,
    plant: Transfer,
    delay_ticks: int = 0,
    reference: ReferencePath = UNFILTERED,
) -> Loop:
    """Return the loop of C(z) with D(s) behind a zero-order hold at the controller's period and `delay_ticks` samples
    of delay.

    `reference` is the pre-filter. Raises ValueError for a plant with direct feedthrough and for a negative delay.
    """
    _require_strictly_proper(plant)
    period_s = controller.period_s
    sampled, between = hold_plant(plant, period_s, delay_ticks)
    images = np.concatenate([controller.zeros, controller.poles])
    roots = np.concatenate([_rates(images, period_s), plant.poles])
    static_gain = controller.dc_gain * plant.dc_gain
    loop = Loop(controller.system, sampled, static_gain, roots, period_s, between, reference)
    if isinstance(controller, DiscreteController):
        return loop
    loop = replace(loop, reference_fault=controller.reference_fault)
    if controller.with_reference is None:
        return loop
    a, b, c, d = controller.with_reference
    column, direct = b[:, 1], float(d[0, 1])
    return replace(
        loop,
        controller=System(a, b[:, 0], c[0], float(d[0, 0])),
        law_reference=LawReference(np.concatenate([column, direct * sampled.b]), direct * between.direct, direct),
    )


def sampled_plant(plant: Transfer, period_s: float, delay_ticks: int = 0) -> System:
    """Return D(s) behind a zero-order hold and `delay_ticks` samples of delay, sample to sample.

    D(s) must have fewer zeros than poles, which is not checked. Raises ValueError for a negative delay and for a period
    that is not a positive number.
    """
    return hold_plant(plant, period_s, delay_ticks).system


def _rates(images: Complex, period_s: float) -> Complex:
    """Return log(z)/T in rad/s for roots in z, without those at |z| ≤ 1e-9, which decay within a sample."""
    return (np.log(images[np.abs(images) > 1e-9].astype(complex)) / period_s).astype(complex)


def realise_transfer(transfer: Transfer) -> System:
    """Return a real, well-conditioned state space of a transfer function in s."""
    points = imaginary_axis_points(np.concatenate([transfer.zeros, transfer.poles]))
    return realise(transfer.zeros, transfer.poles, transfer.gain, points)[0]


def _require_strictly_proper(plant: Transfer) -> None:
    """Raise ValueError for a plant with as many zeros as poles."""
    if not plant.is_strictly_proper:
        raise ValueError(
            f"plant: {plant.zeros.size} zeros and {plant.order} poles; allowed: fewer zeros than poles "
            "(no direct feedthrough)"
        )

"""Linear controller of several axes: x⁺ = A x + B e, v = W (C x + D e), e and v with an entry for each axis.

W is a decoupling matrix. If the axes of a stage move each other, position = P K v with the dynamics P of each axis and
a matrix K, then W = K⁻¹ makes the loops independent. The states follow the applied commands in the observer form of
anti-windup (Åström and Wittenmark, Computer-Controlled Systems, 1997), with a column for each command.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.foundation.native.compiled import jit
from rtloop.kernel.layout import MAX_COUPLED, cache_line_record
from rtloop.kernel.validity import Allowed
from rtloop.laws.contract import CoupledController
from rtloop.laws.shipped.options import CoupledOptions
from rtloop.linear.realisation import row_bands

if TYPE_CHECKING:
    from rtloop.linear.coupled_systems import SampledCoupledSystem

MAX_ORDER = 48
COEFFICIENTS = cache_line_record(
    [
        ("a", np.float64, (MAX_ORDER, MAX_ORDER)),
        *((name, np.float64, (MAX_ORDER, MAX_COUPLED)) for name in ("b", "tracking", "steady_state")),
        ("c", np.float64, (MAX_COUPLED, MAX_ORDER)),
        ("d", np.float64, (MAX_COUPLED, MAX_COUPLED)),
        ("row_start", np.uint8, (MAX_ORDER,)),
        ("row_stop", np.uint8, (MAX_ORDER,)),
        ("order", np.uint8),
        ("count", np.uint8),
        ("unused", np.uint8, (6,)),
        ("share", np.float64),
    ]
)
STATE = cache_line_record([("x", np.float64, (MAX_ORDER,)), ("scratch", np.float64, (MAX_ORDER,))])


@jit
def commands(c, s, told):
    """Set told.command_um to v = C x + D e, (axes,) in µm, from states x and errors e; C and D include W."""
    for i in range(c.count):
        told.command_um[i] = _command(c, s, told, i)


@jit
def _command(c, s, told, i):
    """Return the command of axis `i` in µm."""
    command_um = 0.0
    for j in range(c.order):
        command_um += c.c[i, j] * s.x[j]
    for j in range(c.count):
        command_um += c.d[i, j] * told.error_um[j]
    return command_um


@jit
def advance(c, s, told):
    """Advance the state x by a tick: x⁺ = A (x + share · M (v_applied − v)) + B e.

    e are the errors, v the commands, both (axes,) in µm; M is the anti-windup matrix `tracking` (states, axes).
    """
    for j in range(c.order):
        s.scratch[j] = s.x[j]
        for i in range(c.count):
            s.scratch[j] += c.share * c.tracking[j, i] * (told.applied_um[i] - told.command_um[i])
    for j in range(c.order):
        value = 0.0
        for k in range(c.row_start[j], c.row_stop[j]):
            value += c.a[j, k] * s.scratch[k]
        for i in range(c.count):
            value += c.b[j, i] * told.error_um[i]
        s.x[j] = value


@jit
def continue_from_commands(c, s, told):
    """Set the state so that the controller continues from the commands told.command_um, (axes,) in µm.

    The state is the steady state for the errors told.error_um, corrected along the anti-windup matrix `tracking`.
    """
    for j in range(c.order):
        s.x[j] = 0.0
        for i in range(c.count):
            s.x[j] += c.steady_state[j, i] * told.error_um[i]
    for i in range(c.count):
        gap_um = told.command_um[i] - _command(c, s, told, i)
        for j in range(c.order):
            s.scratch[j] = (s.scratch[j] if i > 0 else 0.0) + c.tracking[j, i] * gap_um
    for j in range(c.order):
        s.x[j] += s.scratch[j]


class Coupled(CoupledController):
    """Transfer functions behind a decoupling matrix, or a state space, for 2 to 8 axes."""

    kind = "coupled"
    options_model = CoupledOptions
    coefficients, state = COEFFICIENTS, STATE
    allowed_coefficients = MappingProxyType(
        {
            "order": Allowed(0, MAX_ORDER),
            "count": Allowed(0, MAX_COUPLED),
            "row_start": Allowed(0, MAX_ORDER),
            "row_stop": Allowed(0, MAX_ORDER),
        }
    )
    shipped = True
    output, update, enter = commands, advance, continue_from_commands

    @cached_property
    def _controller_and_tracking(self) -> tuple[SampledCoupledSystem, Real]:
        """Discrete controller with its decoupling, and its anti-windup matrix M (states, axes).

        Raises ValueError for options that cannot be discretised.
        """
        from rtloop.linear.antiwindup import antiwindup_matrix
        from rtloop.linear.coupled_systems import CoupledSystem, SampledCoupledSystem, block_diagonal_system, tustin
        from rtloop.linear.discretise import discretise_controller

        options: CoupledOptions = self.options
        decoupling = np.array(options.decoupling) if options.decoupling else np.eye(self.count)
        if options.loops:
            loops = [
                discretise_controller(
                    loop_options.transfer(), self.period_s, loop_options.method, loop_options.prewarp_hz
                )
                for loop_options in options.loops
            ]
            system = block_diagonal_system([loop.system for loop in loops])
            loop_tracking = block_diagonal_system([loop.system._replace(b=loop.antiwindup) for loop in loops]).b
            tracking = loop_tracking @ np.linalg.inv(decoupling)
        else:
            order = len(options.a)
            arrays = [np.array(getattr(options, name), float) for name in "abcd"]
            shapes = ((order, order), (order, self.count), (self.count, order), (self.count, self.count))
            matrices = [matrix.reshape(shape) for matrix, shape in zip(arrays, shapes, strict=True)]
            system = tustin(CoupledSystem(*matrices), self.period_s, options.prewarp_hz)
            tracking = antiwindup_matrix(system.a, system.b, decoupling @ system.c)
        return SampledCoupledSystem(system.transform(after=decoupling), self.period_s), tracking

    def build(self) -> Mapping[str, npt.ArrayLike]:
        """Return `order`, `count` (of axes), `a`, `b`, `c`, `d` of the discrete controller with its decoupling, and the
        coefficients of its anti-windup and of its entry.

        `tracking` is the anti-windup matrix M, `share` the fraction of it that is applied in a tick, `steady_state` the
        states (states, axes) per error at rest; `row_start` and `row_stop` bound the non-zero columns of a row of A.
        Raises ValueError for too high an order, an unstable anti-windup, and options that cannot be discretised.
        """
        from rtloop.linear.antiwindup import tracking_share

        controller, tracking = self._controller_and_tracking
        a, b, c, d = controller.system
        if controller.order > MAX_ORDER:
            raise ValueError(f"order {controller.order}; allowed: up to {MAX_ORDER}")
        bands = row_bands(a)
        return {
            "order": controller.order,
            "count": self.count,
            "a": a,
            "b": b,
            "c": c,
            "d": d,
            "row_start": bands[:, 0],
            "row_stop": bands[:, 1],
            "tracking": tracking,
            "steady_state": np.linalg.pinv(np.eye(controller.order) - a, rcond=1e-9) @ b,
            "share": tracking_share(a, tracking, c, self.options.tracking_s, self.period_s),
        }

    def linear(self) -> SampledCoupledSystem:
        """Return the transfer from errors to commands, with the decoupling.

        Raises ValueError for options that cannot be discretised.
        """
        return self._controller_and_tracking[0]

"""Linear controller C(z) from error to command, in state space: x⁺ = A x + b e, v = c x + d e.

`rtloop.linear.discretise` computes it from C(s); `build` imports it, so that a running loop does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rtloop.foundation.native.compiled import jit, jit_inline
from rtloop.kernel.layout import cache_line_record
from rtloop.kernel.validity import SWITCH, Allowed
from rtloop.laws.contract import Controller
from rtloop.laws.shipped.lanes import BLOCK, LANES, sum_lanes
from rtloop.laws.shipped.options import TransferControllerOptions
from rtloop.linear.realisation import blocks, row_bands

if TYPE_CHECKING:
    from rtloop.linear.discretise import DiscreteController

MAX_ORDER = 24
# States are in blocks of four pairs: four first states, then their four partners. A within the pairs is `own` and
# `partner`; `coupling` has the other elements of A, which are non-zero in columns start ≤ j < stop of a row.
COEFFICIENTS = cache_line_record(
    [
        *((name, np.float64, (MAX_ORDER,)) for name in ("own", "partner", "b", "c", "tracking", "steady_state")),
        ("coupling", np.float64, (MAX_ORDER, MAX_ORDER)),
        ("row_start", np.uint8, (MAX_ORDER,)),
        ("row_stop", np.uint8, (MAX_ORDER,)),
        ("order", np.uint8),
        ("coupled", np.uint8),
        ("unused", np.uint8, (6,)),
        ("d", np.float64),
        ("tracking_share", np.float64),
    ]
)
STATE = cache_line_record(
    [
        ("controller", np.float64, (MAX_ORDER,)),
        ("scratch", np.float64, (MAX_ORDER,)),
        ("sums", np.float64, (LANES,)),
    ]
)


@jit
def command(c, s, told):
    """Return the command v = c x + d e in µm, from the states x and the error e in µm.

    s[i mod 4] += c_i x_i + c_i+4 x_i+4 for i = 0 … 3, 8 … 11, …, then (s0 + s1) + (s2 + s3) + d e.
    """
    w, x = c.c, s.controller
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for block in range(c.order // BLOCK):
        i = block * BLOCK
        first += w[i] * x[i] + w[i + 4] * x[i + 4]
        second += w[i + 1] * x[i + 1] + w[i + 5] * x[i + 5]
        third += w[i + 2] * x[i + 2] + w[i + 6] * x[i + 6]
        fourth += w[i + 3] * x[i + 3] + w[i + 7] * x[i + 7]
    return sum_lanes(s.sums, first, second, third, fourth) + c.d * told.error_um


@jit
def advance(c, s, told):
    """Advance the state x by a tick: x⁺ = A (x + m · tracking_share · (v_applied − v)) + b e.

    e is the error, v the command, both in µm; m is the anti-windup vector `tracking`. With a share of 1 the state is as
    if C had output the applied command: c·m = 1 (observer form of anti-windup; Åström and Wittenmark,
    Computer-Controlled Systems, 1997).
    """
    error_um, shortfall_um = told.error_um, c.tracking_share * (told.applied_um - told.command_um)
    if c.coupled != 0:
        for i in range(c.order):
            s.scratch[i] = s.controller[i] + c.tracking[i] * shortfall_um
    x = s.controller
    for block in range(c.order // BLOCK):
        i = block * BLOCK
        state_0, partner_0 = _next_pair(c, s, i, error_um, shortfall_um)
        state_1, partner_1 = _next_pair(c, s, i + 1, error_um, shortfall_um)
        state_2, partner_2 = _next_pair(c, s, i + 2, error_um, shortfall_um)
        state_3, partner_3 = _next_pair(c, s, i + 3, error_um, shortfall_um)
        x[i], x[i + 1], x[i + 2], x[i + 3] = state_0, state_1, state_2, state_3
        x[i + 4], x[i + 5], x[i + 6], x[i + 7] = partner_0, partner_1, partner_2, partner_3
    if c.coupled != 0:
        for i in range(c.order):
            for j in range(c.row_start[i], c.row_stop[i]):
                s.controller[i] += c.coupling[i, j] * s.scratch[j]


@jit_inline
def _next_pair(c, s, i, error_um, shortfall_um):
    """Return states i and i + LANES after a tick, without the part of the matrix `coupling`; the states stay.

    `shortfall_um` is tracking_share · (v_applied − v).
    """
    j = i + LANES
    first = s.controller[i] + c.tracking[i] * shortfall_um
    second = s.controller[j] + c.tracking[j] * shortfall_um
    return (
        c.own[i] * first + c.partner[i] * second + c.b[i] * error_um,
        c.own[j] * second + c.partner[j] * first + c.b[j] * error_um,
    )


@jit
def continue_from_command(c, s, told):
    """Set the state so that the controller continues from the command told.command_um, in µm.

    The state is the steady state for the error told.error_um, corrected along the anti-windup vector `tracking`.
    """
    for i in range(c.order):
        s.controller[i] = c.steady_state[i] * told.error_um
    gap = told.command_um - command(c, s, told)
    for i in range(c.order):
        s.controller[i] += c.tracking[i] * gap


class TransferController(Controller):
    """C(s), discretised, with anti-windup by the applied command."""

    kind = "transfer"
    options_model = TransferControllerOptions
    coefficients, state = COEFFICIENTS, STATE
    allowed_coefficients = MappingProxyType(
        {
            "order": Allowed(0, MAX_ORDER, BLOCK),
            "coupled": SWITCH,
            "row_start": Allowed(0, MAX_ORDER),
            "row_stop": Allowed(0, MAX_ORDER),
        }
    )
    shipped = True
    output, update, enter = command, advance, continue_from_command

    @cached_property
    def discrete(self) -> DiscreteController:
        """C(z) in state space, with its anti-windup vector. Raises ValueError for a C(s) that cannot be discretised."""
        from rtloop.linear.discretise import discretise_controller

        options: TransferControllerOptions = self.options
        return discretise_controller(options.transfer(), self.period_s, options.method, options.prewarp_hz)

    def build(self) -> Mapping[str, npt.ArrayLike]:
        """Return the values of COEFFICIENTS by name: C(z), its anti-windup and its entry, with the states in the
        kernels' order.

        Raises ValueError for too high an order, an unstable anti-windup, and a C(s) that cannot be discretised.
        """
        from rtloop.linear.antiwindup import tracking_share

        controller = self.discrete
        order = controller.b.size
        if order > MAX_ORDER:
            raise ValueError(f"order {order}; allowed: up to {MAX_ORDER}")
        a, m, c = controller.a, controller.antiwindup, controller.c
        share = tracking_share(a, m, c, self.options.tracking_s, self.period_s)
        places = _kernel_places(controller.a)
        a = np.zeros((MAX_ORDER, MAX_ORDER))
        a[np.ix_(places, places)] = controller.a
        states = np.arange(MAX_ORDER)
        partners = states ^ LANES
        diagonal, partner = a[states, states], a[states, partners]
        a[states, states] = a[states, partners] = 0.0
        bands = row_bands(a)
        return {
            "order": -(-(int(places.max(initial=-1)) + 1) // BLOCK) * BLOCK,
            "own": diagonal,
            "partner": partner,
            "coupling": a,
            "coupled": bool(a.any()),
            "row_start": bands[:, 0],
            "row_stop": bands[:, 1],
            "b": _reorder(controller.b, places),
            "c": _reorder(c, places),
            "d": controller.d,
            "tracking": _reorder(m, places),
            "steady_state": _reorder(controller.steady_state_gain, places),
            "tracking_share": share,
        }

    def linear(self) -> DiscreteController:
        """Return the transfer from error to command. Raises ValueError for a C(s) that cannot be discretised."""
        return self.discrete


def _reorder(values: npt.NDArray[np.float64], places: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Return a vector (MAX_ORDER,) with values[i] at index places[i] and 0 elsewhere."""
    vector = np.zeros(MAX_ORDER)
    vector[places] = values
    return vector


def _kernel_places(a: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return the place of each state in the kernels' order: blocks of four pairs, a pair's two states LANES apart.

    The two states of a 2×2 block of A make a pair, and so do the other states, two by two.
    """
    diagonal_blocks = blocks(a)
    pairs = [(block.start, block.start + 1) for block in diagonal_blocks if block.stop - block.start == 2]
    single = [block.start for block in diagonal_blocks if block.stop - block.start == 1]
    pairs += [tuple(single[i : i + 2]) for i in range(0, len(single), 2)]
    places = np.zeros(a.shape[0], np.int64)
    for number, pair in enumerate(pairs):
        for half, state in enumerate(pair):
            places[state] = number // LANES * BLOCK + number % LANES + half * LANES
    return places

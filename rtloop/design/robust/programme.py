"""Both rows of taps as a linear programme: x and v of every scenario are linear in the taps.

    least ε :   x ≤ 1 + ε always,   |x − 1| ≤ band from the settling time on,   x ≥ −undershoot,
                low ≤ v ≤ high,   x → 1 at rest                             in every scenario, between ticks too
    then, at the allowed ε:   least Σ |v[k] − v[k−1]| on the model, with a small penalty on the taps

A programme is solved on some of its rows; rows that the solution violates are added until it violates none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog
from scipy.sparse import csr_array

from rtloop.design.robust.responses import Responses, delayed_columns
from rtloop.errors import NoDesign
from rtloop.foundation.arrays import Real

BAND = 0.05
"""Settling band to each side of the final value, as a fraction of it."""
TOLERANCE = 1e-7
"""Largest violation of a row that counts as none: 4 pm of 40 µm."""
ROW_STRIDE, MOST_NEW = 7, 400
"""Stride in ticks of the initial rows while the taps last; most rows added at once."""
TAP_WEIGHT = 0.01
"""Weight of the taps' sizes relative to the variation of v: without it the two rows could cancel each other without
bound.
"""
USED_SHARE = 0.99
"""Fraction of each limit that a programme uses, as a margin for the gaps between its points and its scenarios."""
LARGEST_TAP = 20.0
"""Bound on a tap, far beyond any drive; without it the solver's presolve may fail."""
LARGEST_PRICE = 1e5
"""Cost of violating a row by 1: larger than any cost of meeting all rows, where all can be met."""
SOLVER_TOLERANCE = 1e-6
"""Violation of a row by the solver that still counts as met."""


class Bounds(NamedTuple):
    """x ≥ −undershoot after a unit step; v within `low_um` … `high_um` for steps by up to `step_um` between levels of
    `lowest_um` … `highest_um`.
    """

    undershoot: float
    step_um: float
    lowest_um: float
    low_um: float
    high_um: float

    @property
    def highest_um(self) -> float:
        """Highest level: one step above the lowest one, or above 0 if that is negative."""
        return max(self.lowest_um, 0.0) + self.step_um

    def command_limits(self, static: Real) -> tuple[Real, Real]:
        """Return least and largest v per unit step that keep v within `low_um` … `high_um` in every step of up to
        `step_um` between the levels, in the shape of `static`, v/x at rest.
        """
        step, lowest, highest = self.step_um, self.lowest_um, self.highest_um
        low = np.maximum(self.low_um - lowest * static, highest * static - self.high_um) / step
        high = np.minimum(self.high_um - (highest - step) * static, (lowest + step) * static - self.low_um) / step
        return low, high


class Taps(NamedTuple):
    """Taps of the reference (n,) and of the direct path into the command (n,), with their overshoot ε."""

    reference: Real
    command: Real
    overshoot: float


class Programme:
    """Linear programme over the responses of scenarios; the first one is the model.

    `taps` is the number in each row, `points` the number of position samples per tick, `band` the settling band, a
    fraction. Solutions use USED_SHARE of the band and of the largest overshoot. Rows that a solution violated stay in
    `active`, so that later solutions begin with them. A solution raises NoDesign if no solver finishes.
    """

    def __init__(self, scenario_responses: list[Responses], taps: int, points: int, bounds: Bounds, band: float = BAND):
        """Set up the rows of the programme from `scenario_responses`, the model's first; `points` are positions a tick.

        `taps` is their number in each of the two rows, `band` the settling band as a fraction. The first solution uses
        only some of the rows, marked in `active`.
        """
        self.taps, self.points, self.band = taps, points, band
        self.ticks = scenario_responses[0].command.shape[1]
        self.time = np.tile(np.arange(1, self.ticks * points + 1) / points, len(scenario_responses))
        position = np.vstack([self._delayed_rows(response.position, points) for response in scenario_responses])
        self.command = np.vstack([self._delayed_rows(response.command, 1) for response in scenario_responses])
        self.rows = np.vstack([position, self.command])
        static = np.repeat([response.static_command for response in scenario_responses], self.ticks)
        self.low, self.high = bounds.command_limits(static)
        self.undershoot = bounds.undershoot
        self.active = np.zeros(self.rows.shape[0], bool)
        is_within_taps = np.concatenate([self.time, np.tile(np.arange(self.ticks), len(scenario_responses))]) <= taps
        self.active[: self.time.size : ROW_STRIDE * points] = True
        self.active[self.time.size :: ROW_STRIDE] = True
        self.active &= is_within_taps
        self.static = np.concatenate([np.ones(taps), np.zeros(taps)])

    def is_feasible(self, settling: float, overshoot: float) -> bool:
        """Whether some taps settle in `settling` ticks in every scenario, with an overshoot up to USED_SHARE of
        `overshoot`, a fraction of the step. Raises NoDesign if no solver finishes.
        """
        return self._solve(settling, np.eye(2 * self.taps + 1)[-1], overshoot) is not None

    def least_overshoot_taps(self, settling: float) -> Taps | None:
        """Return the taps of least overshoot ε that settle in `settling` ticks in every scenario; None if none do with
        ε up to USED_SHARE of the band. Raises NoDesign if no solver finishes.
        """
        solved = self._solve(settling, np.eye(2 * self.taps + 1)[-1], None)
        return None if solved is None else self._split_taps(solved)

    def quietest_taps(self, settling: float, overshoot: float) -> Taps | None:
        """Return the taps that settle in `settling` ticks in every scenario, with an overshoot up to USED_SHARE of
        `overshoot`, and with the least total variation of the command v on the model; None if no taps settle so.

        Raises NoDesign if no solver finishes.
        """
        rows = self._penalty_rows()
        weights = np.where(np.arange(rows.shape[0]) < rows.shape[0] - 2 * self.taps, 1.0, TAP_WEIGHT)
        cost = np.concatenate([np.zeros(2 * self.taps + 1), weights])
        solved = self._solve(settling, cost, overshoot, rows)
        return None if solved is None else self._split_taps(solved)

    def _split_taps(self, solved: Real) -> Taps:
        """Return the taps and ε from a solution's variables."""
        return Taps(solved[: self.taps], solved[self.taps : 2 * self.taps], float(solved[2 * self.taps]))

    def _delayed_rows(self, steps: Real, points: int) -> Real:
        """Return the responses to both rows of taps, with `points` values a tick, (values, 2·taps); `steps` is (2,
        values).
        """
        return np.hstack([delayed_columns(step, self.taps, points) for step in steps])

    def _solve(
        self, settling: float, cost: Real, overshoot: float | None, penalised: Real | None = None
    ) -> Real | None:
        """Return the variables of least `cost`: taps, ε, then |row·taps| of each row of `penalised`; None if
        infeasible.

        `settling` in ticks, ε up to USED_SHARE of `overshoot` (None: of the band). Rows that were violated stay in
        `active`. Raises NoDesign if no solver finishes.
        """
        count, extra = 2 * self.taps + 1, cost.size - 2 * self.taps - 1
        is_settled = self.time >= settling - 1e-9
        low = np.concatenate([np.where(is_settled, 1 - USED_SHARE * self.band, -self.undershoot), self.low])
        high = np.concatenate([np.full(self.time.size, 1.0), self.high])
        slack = np.concatenate([np.ones(self.time.size), np.zeros(self.command.shape[0])])
        rows = self.rows
        limits: list[tuple[float, float | None]] = [(-LARGEST_TAP, LARGEST_TAP)] * (count - 1)
        limits += [(0.0, USED_SHARE * (self.band if overshoot is None else overshoot)), *[(0.0, None)] * extra]
        static = np.concatenate([self.static, np.zeros(1 + extra)])[None]
        while True:
            rows_used = np.flatnonzero(self.active)
            parts = [
                np.hstack([rows[rows_used], -slack[rows_used, None]]),
                np.hstack([-rows[rows_used], np.zeros((rows_used.size, 1))]),
            ]
            limit = np.concatenate([high[rows_used], -low[rows_used], np.zeros(2 * extra)])
            matrix = np.vstack([np.hstack([part, np.zeros((rows_used.size, extra))]) for part in parts])
            if penalised is not None:
                matrix = np.vstack([matrix, *_size_rows(penalised)])
            solution = _solve_dual(cost, matrix, limit, static, limits)
            if solution is None:
                return None
            values = rows @ solution[: count - 1]
            violation = np.maximum(values - high - slack * solution[count - 1], low - values)
            violation[self.active] = 0.0
            new_rows = np.flatnonzero(violation > TOLERANCE)
            if not new_rows.size:
                return solution
            self.active[_worst_rows(violation, new_rows)] = True

    def _penalty_rows(self) -> Real:
        """Return the rows (k, 2·taps) whose absolute values are penalised: changes of v from tick to tick on the
        model, then the taps themselves.
        """
        v = self.command[: min(self.ticks, 2 * self.taps + 40)]
        return np.vstack([np.diff(v, axis=0, prepend=np.zeros((1, v.shape[1]))), np.eye(2 * self.taps)])


def _size_rows(rows: Real) -> tuple[Real, Real]:
    """Return two matrices for rows·taps − s ≤ 0 and −rows·taps − s ≤ 0, in the variables taps, ε, s."""
    overshoot_column, sizes = np.zeros((rows.shape[0], 1)), -np.eye(rows.shape[0])
    return np.hstack([rows, overshoot_column, sizes]), np.hstack([-rows, overshoot_column, sizes])


def _solve_dual(
    cost: Real, matrix_a: Real, limit: Real, static: Real, limits: Sequence[tuple[float, float | None]]
) -> Real | None:
    """Return the variables x of least `cost`·x with A x ≤ b, static response 1 and x within `limits`; None if
    infeasible.

    A is `matrix_a`, b `limit`, and the row `static` (1, variables) times x the static response. Raises NoDesign if no
    solver finishes.

    The dual is solved: least b·y + z with Aᵀy + zs = −c and 0 ≤ y ≤ LARGEST_PRICE. It has tens of rows for the
    thousands of A, many nearly equal, among which a simplex may take minutes instead of fractions of a second. A row
    may be violated at LARGEST_PRICE, so that there is always a solution; if it violates a row, the problem is
    infeasible.
    """
    low, high = np.array([(lower, np.inf if upper is None else upper) for lower, upper in limits]).T
    bounded, identity = np.isfinite(high), np.eye(cost.size)
    rows = np.vstack([matrix_a, identity[bounded], -identity])
    allowed = np.concatenate([limit, high[bounded], -low])
    matrix = csr_array(np.vstack([rows, static]).T)
    prices: list[tuple[float | None, float | None]] = [(0.0, LARGEST_PRICE)] * rows.shape[0] + [(None, None)]
    for method, presolve in (("highs-ds", True), ("highs-ds", False), ("highs-ipm", True)):
        result = linprog(
            np.append(allowed, 1.0), A_eq=matrix, b_eq=-cost, bounds=prices, method=method,
            options={"presolve": presolve},
        )  # fmt: skip
        if result.status == 0:
            multipliers = np.asarray(result.eqlin.marginals, dtype=float)
            return multipliers if np.max(rows @ multipliers - allowed) <= SOLVER_TOLERANCE else None
    raise NoDesign(
        f"shape: the linear programme for the taps was not solved: {result.message}. Use another number of shape.taps "
        "or shape.points_per_tick"
    )


def _worst_rows(violation: Real, candidates: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return the indices of rows that are violated most among their neighbours, at most MOST_NEW, worst first.

    `violation` (rows,) has all rows, `candidates` the indices of the violated ones.
    """
    previous, following = np.r_[0.0, violation[:-1]], np.r_[violation[1:], 0.0]
    peaks = candidates[
        (violation[candidates] >= previous[candidates]) & (violation[candidates] >= following[candidates])
    ]
    return peaks[np.argsort(-violation[peaks])[:MOST_NEW]]

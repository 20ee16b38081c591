"""A controller's linear part, found by running its functions: differences about its rest, one state after the other.

From rest at position, reference and command 0, with the reference held: an error e is a position −e.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.law.layout import CONTROL
from rtloop.law.memory import records
from rtloop.laws.contract import Controller, record_of
from rtloop.linear.realisation import System
from rtloop.linear.sampled import Sampled

STEP = 1e-4
AGREEMENT = 1e-4
"""Of the derivatives by STEP and by half of it: beyond, the law bends, or has a corner, at its rest."""
MOST_STATES = 400
Real = npt.NDArray[np.float64]


def linear_part(law: Controller) -> Any:
    """What the law itself says of it, or else what is found. Raises ValueError where nothing can be."""
    known = law.linear()
    return linearised(law) if known is None else known


def linearised(law: Controller) -> Sampled:
    """The law about its rest. Raises ValueError where it has too many states, is not smooth there, or fails there."""
    tick = _Tick(law)
    if tick.size > MOST_STATES:
        raise ValueError(f"{tick.size} states; at most {MOST_STATES} are found out one by one")
    try:
        with np.errstate(all="ignore"):
            wide, narrow = _derivatives(tick, STEP), _derivatives(tick, STEP / 2)
    except (ArithmeticError, IndexError, ValueError) as error:
        raise ValueError(f"at rest it fails: {type(error).__name__}: {error}") from error
    scale = np.abs(wide).max(axis=1, keepdims=True, initial=0.0) + 1e-12
    if not np.all(np.abs(wide - narrow) <= AGREEMENT * scale):
        raise ValueError("it is not smooth at rest")
    n = tick.size
    a, b, c, d = narrow[:n, :n], narrow[:n, n], narrow[n, :n], float(narrow[n, n])
    kept = np.flatnonzero(_reached(a, b) & _reached(a.T, c))
    return Sampled(System(a[np.ix_(kept, kept)], b[kept], c[kept], d), law.period_s)


def _reached(a: Real, b: Real) -> npt.NDArray[np.bool_]:
    """States that the input reaches at all, (n,); with Aᵀ and c those that the output sees. Counters are neither."""
    reached = b != 0
    while True:
        wider = reached | np.any((a != 0) & reached, axis=1)
        if np.array_equal(wider, reached):
            return reached
        reached = wider


def _derivatives(tick: _Tick, step: float) -> Real:
    """Of the states after a tick and of the command (n + 1,), by the states before it and the error (n + 1)."""
    size = tick.size
    found = np.zeros((size + 1, size + 1))
    for i in range(size + 1):
        at = np.zeros(size + 1)
        at[i] = step
        found[:, i] = (tick(at[:-1], at[-1]) - tick(-at[:-1], -at[-1])) / (2 * step)
    return found


class _Tick:
    """One tick of the uncompiled functions: from floating-point states and error to states and command."""

    def __init__(self, law: Controller) -> None:
        keeps = law.records()
        self._coefficients: Any = record_of(law).view(np.recarray)[0]
        self._state = records(keeps.state, 1)
        self._fields = [name for name in keeps.state.names or () if keeps.state[name].base == np.float64]
        self._fields = [name for name in self._fields if name not in ("reserved", "scratch")]
        self._output, self._update = as_written(type(law).output), as_written(type(law).update)
        self.size = sum(int(np.prod(keeps.state[name].shape)) for name in self._fields)

    def __call__(self, states: Real, error_um: float) -> Real:
        self._state.view(np.uint8)[:] = 0
        at = 0
        for name in self._fields:
            target = self._state[name].reshape(-1)
            target[:] = states[at : at + target.size]
            at += target.size
        told = records(CONTROL, 1)
        told.position_um, told.error_um = -error_um, error_um
        state = self._state[0]
        command_um = float(self._output(self._coefficients, state, told[0]))
        told.command_um = told.applied_um = command_um
        self._update(self._coefficients, state, told[0])
        return np.concatenate([*(self._state[name].reshape(-1) for name in self._fields), [command_um]])


def as_written(function: Any) -> Callable[..., Any]:
    """What a kernel was compiled from."""
    return getattr(function, "py_func", function)

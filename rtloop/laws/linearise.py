"""Linear part of a controller, from its functions: differences about its rest, one state after the other.

At rest position, reference and command are 0; the reference is constant, so that an error e is a position −e.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.kernel.layout import control_dtype
from rtloop.kernel.memory import new_records
from rtloop.laws.contract import Controller, build_record
from rtloop.linear.coupled_systems import CoupledSystem, SampledCoupledSystem
from rtloop.linear.realisation import System
from rtloop.linear.sampled import SampledController

NOT_LINEAR = "cannot be linearised about its rest state"
"""Fault of a controller without a linear part, in messages."""
STEP = 1e-4
AGREEMENT = 1e-4
"""Allowed relative difference of the derivatives by STEP and by STEP / 2; a law with more is not smooth at rest."""
MAX_STATES = 400


def linear_part(law: Controller) -> Any:
    """Return the law's `linear()`, or, if that is None, its linearisation at rest: the transfer from error to command.

    The type is SampledController or DiscreteController, for several axes SampledCoupledSystem. Raises ValueError for a
    law that cannot be linearised: it has more than MAX_STATES states, is not smooth at rest or fails there.
    """
    declared = law.linear()
    return linearise_at_rest(law) if declared is None else declared


def linearise_at_rest(law: Controller) -> SampledController | SampledCoupledSystem:
    """Return the linearisation of a law about its rest: a SampledCoupledSystem for several axes.

    States that no error reaches, or that reach no command, are left out. Raises ValueError for a law that has more than
    MAX_STATES states, is not smooth at rest or fails there.
    """
    tick = _Tick(law)
    if tick.size > MAX_STATES:
        raise ValueError(f"the law has {tick.size} states; allowed in a linearisation: up to {MAX_STATES}")
    try:
        with np.errstate(all="ignore"):
            wide, narrow = _derivatives(tick, STEP), _derivatives(tick, STEP / 2)
        if not (np.isfinite(wide).all() and np.isfinite(narrow).all()):
            with np.errstate(divide="raise", invalid="raise"):  # names the line, if a division is the cause
                _derivatives(tick, STEP)
                _derivatives(tick, STEP / 2)
            raise ValueError("the results are not finite")
    except (ArithmeticError, IndexError, ValueError) as error:
        reason = f"{_place(error, type(law))}{type(error).__name__}: {error}"
        raise ValueError(f"the law fails at rest: {reason}") from error
    n = tick.size
    is_minimal = _reachable_states(narrow[:n, :n], narrow[:n, n:]) & _reachable_states(
        narrow[:n, :n].T, narrow[n:, :n].T
    )
    indices = np.concatenate([np.flatnonzero(is_minimal), np.arange(n, len(narrow))])
    wide, narrow, n = wide[np.ix_(indices, indices)], narrow[np.ix_(indices, indices)], int(is_minimal.sum())
    scale = np.abs(wide).max(axis=1, keepdims=True, initial=0.0) + 1e-12
    if not np.all(np.abs(wide - narrow) <= AGREEMENT * scale):
        raise ValueError(
            "the law is not smooth at rest: small changes of its errors and states give changes that are not "
            "proportional to them"
        )
    a, b, c, d = narrow[:n, :n], narrow[:n, n:], narrow[n:, :n], narrow[n:, n:]
    if law.count > 1:
        return SampledCoupledSystem(CoupledSystem(a, b, c, d), law.period_s)
    return SampledController(System(a, b[:, 0], c[0], float(d[0, 0])), law.period_s)


def _place(error: Exception, law: type[Controller]) -> str:
    """Return the place in the law's files where an error was raised, as "FILE, line N: "; "" if it was elsewhere."""
    files = {python_function(function).__code__.co_filename for function in (law.output, law.update)}
    places = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    places = [(file, line) for file, line in places if file in files]
    return f"{places[-1][0]}, line {places[-1][1]}: " if places else ""


def _reachable_states(a: Real, b: Real) -> npt.NDArray[np.bool_]:
    """Return a mask (n,), True for states that an input reaches by non-zero elements of `a` (n, n) and `b` (n, inputs).

    With Aᵀ and Cᵀ it is True for the states that reach an output.
    """
    reachable = np.any(b != 0, axis=1)
    while True:
        wider = reachable | np.any((a != 0) & reachable, axis=1)
        if np.array_equal(wider, reachable):
            return reachable
        reachable = wider


def _derivatives(tick: _Tick, step: float) -> Real:
    """Return the derivatives (n + m, n + m), from differences of ±`step` about rest.

    A row is a next state (n) or a command (m), a column a state (n) or an error (m).
    """
    size = tick.size + tick.axes
    matrix = np.zeros((size, size))
    for i in range(size):
        point = np.zeros(size)
        point[i] = step
        matrix[:, i] = (
            tick(point[: tick.size], point[tick.size :]) - tick(-point[: tick.size], -point[tick.size :])
        ) / (2 * step)
    return matrix


class _Tick:
    """Function from states (n,) and errors (m,) to next states and commands (n + m,): one tick, uncompiled."""

    def __init__(self, law: Controller) -> None:
        """Build the coefficients of the law. Raises ValueError as `build_record` does."""
        records = law.records(law.count)
        self._coefficients: np.record = build_record(law).view(np.recarray)[0]
        self._state = new_records(records.state, 1)
        self._fields = [name for name in records.state.names or () if records.state[name].base == np.float64]
        self._fields = [name for name in self._fields if name not in ("reserved", "scratch")]
        self._output, self._update = python_function(type(law).output), python_function(type(law).update)
        self.size = sum(int(np.prod(records.state[name].shape)) for name in self._fields)
        self.axes = law.count
        self._signals = control_dtype(law.count)

    def __call__(self, states: Real, errors_um: Real) -> Real:
        """Run one tick and return the next states, then the commands (n + m,).

        The tick begins with the values `states` (n,) of all fields of type float, in the order of the record; other
        states are 0. The reference is 0, the positions are −`errors_um` (m,).
        """
        self._state.view(np.uint8)[:] = 0
        offset = 0
        for name in self._fields:
            target = self._state[name].reshape(-1)
            target[:] = states[offset : offset + target.size]
            offset += target.size
        control = new_records(self._signals, 1)
        control.position_um, control.error_um = -errors_um, errors_um
        state = self._state[0]
        returned = self._output(self._coefficients, state, control[0])
        if self.axes == 1:
            control.command_um = returned
        control.applied_um = control.command_um
        self._update(self._coefficients, state, control[0])
        return np.concatenate(
            [*(self._state[name].reshape(-1) for name in self._fields), control.command_um.reshape(-1)]
        )


def python_function(function: Any) -> Callable[..., Any]:
    """Return the Python function of a kernel, or a Python function itself."""
    return getattr(function, "py_func", function)

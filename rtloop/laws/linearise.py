"""Linear part of a controller, from its functions: differences about its rest, one state after the other.

At rest position, reference and command are 0. An error e is a position −e, a reference r without an error a position r:

    v = C e + F r

F is 0 for a law that uses the error alone. A derivative of the position, or a feedforward of the reference, makes it.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import replace
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
REFERENCE_PARTS, REFERENCE_TICKS = (1.0, 0.37, 0.1), 120
"""Parts of the largest reference, and ticks, for which the response to the reference is compared with its linear part.
"""
PROPORTIONAL = 1e-3
"""Allowed difference between them, relative to the reference."""


def linear_part(law: Controller, reach_um: float | None = None) -> Any:
    """Return the law's `linear()`, or, if that is None, its linearisation at rest: the transfer from error to command.

    The type is SampledController or DiscreteController, for several axes SampledCoupledSystem. With the largest
    reference `reach_um`, it has the response to the reference too. Raises ValueError for a law that cannot be
    linearised: it has more than MAX_STATES states, is not smooth at rest or fails there.
    """
    declared = law.linear()
    if declared is None:
        return linearise_at_rest(law, reach_um)
    if reach_um is None or type(law).shipped:  # Shipped laws that declare their linear part use the error alone.
        return declared
    try:
        own = linearise_at_rest(law, reach_um)
        path, fault = own.with_reference, own.reference_fault
    except ValueError as error:
        path, fault = None, _command_without_error(law, reach_um, str(error))
    if path is None and not fault:
        return declared
    kind = SampledController if law.count == 1 else SampledCoupledSystem
    return kind(declared.system, declared.period_s, path, fault)


def linearise_at_rest(law: Controller, reach_um: float | None = None) -> SampledController | SampledCoupledSystem:
    """Return the linearisation of a law about its rest: a SampledCoupledSystem for several axes.

    States that no error reaches, or that reach no command, are left out. With the largest reference `reach_um`, the
    response to the reference is added, or the reason why it is not linear. Raises ValueError for a law that has more
    than MAX_STATES states, is not smooth at rest or fails there.
    """
    tick = _Tick(law)
    if tick.size > MAX_STATES:
        raise ValueError(f"the law has {tick.size} states; allowed in a linearisation: up to {MAX_STATES}")
    columns = range(tick.size + tick.axes)
    try:
        with np.errstate(all="ignore"):
            wide, narrow = _derivatives(tick, STEP, columns), _derivatives(tick, STEP / 2, columns)
        if not (np.isfinite(wide).all() and np.isfinite(narrow).all()):
            with np.errstate(divide="raise", invalid="raise"):  # names the line, if a division is the cause
                _derivatives(tick, STEP, columns)
                _derivatives(tick, STEP / 2, columns)
            raise ValueError("the results are not finite")
    except (ArithmeticError, IndexError, ValueError) as error:
        reason = f"{_place(error, type(law))}{type(error).__name__}: {error}"
        raise ValueError(f"the law fails at rest: {reason}") from error
    a, b, c, d = system = _minimal_system(wide, narrow, tick.size, "errors")
    controller = (
        SampledCoupledSystem(system, law.period_s)
        if law.count > 1
        else SampledController(System(a, b[:, 0], c[0], float(d[0, 0])), law.period_s)
    )
    if reach_um is None:
        return controller
    try:
        with np.errstate(all="ignore"):
            return replace(controller, with_reference=_with_reference(tick, wide, narrow, reach_um))
    except (ArithmeticError, IndexError, ValueError) as error:
        return replace(controller, reference_fault=f"{_place(error, type(law))}{error}")


def _minimal_system(wide: Real, narrow: Real, n: int, inputs: str) -> CoupledSystem:
    """Return the system of the derivatives (n + m, n + inputs), without states that no input reaches or that reach no
    command.

    `narrow` are the derivatives by STEP / 2. Raises ValueError unless they agree with `wide`, those by STEP.
    """
    is_minimal = _reachable_states(narrow[:n, :n], narrow[:n, n:]) & _reachable_states(
        narrow[:n, :n].T, narrow[n:, :n].T
    )
    rows, columns = (np.concatenate([np.flatnonzero(is_minimal), np.arange(n, end)]) for end in narrow.shape)
    wide, narrow, n = wide[np.ix_(rows, columns)], narrow[np.ix_(rows, columns)], int(is_minimal.sum())
    scale = np.abs(wide).max(axis=1, keepdims=True, initial=0.0) + 1e-12
    if not np.all(np.abs(wide - narrow) <= AGREEMENT * scale):
        raise ValueError(
            f"the law is not smooth at rest: small changes of its {inputs} and states give changes that are not "
            "proportional to them"
        )
    return CoupledSystem(narrow[:n, :n], narrow[:n, n:], narrow[n:, :n], narrow[n:, n:])


def _with_reference(tick: _Tick, wide: Real, narrow: Real, reach_um: float) -> CoupledSystem | None:
    """Return the linear part from errors, and from references at errors of 0, to commands; None for a law that uses the
    errors alone.

    `wide` and `narrow` are the derivatives without the references. Raises ValueError for a law that is not linear for
    references up to ±`reach_um`, and what its functions raise.
    """
    first = tick.size + tick.axes
    wide, narrow = (
        np.hstack([matrix, _derivatives(tick, step, range(first, first + tick.axes))])
        for matrix, step in ((wide, STEP), (narrow, STEP / 2))
    )
    system = _minimal_system(wide, narrow, tick.size, "references")
    for part in REFERENCE_PARTS:
        _require_linear(tick, system, part * reach_um)
    is_used = np.any(system.b[:, tick.axes :]) or np.any(system.d[:, tick.axes :])
    return system if is_used else None


def _require_linear(tick: _Tick, system: CoupledSystem, reference_um: float) -> None:
    """Raise ValueError unless the commands for references of ±`reference_um` are those of `system`, and the response to
    small errors is the same as without a reference.
    """
    references_um, errors_um = reference_um * _test_signals(tick.axes), STEP * _test_signals(tick.axes)[::-1]
    rest = np.zeros_like(references_um)
    commands_um, states = tick.run(rest, references_um), np.zeros(len(system.a))
    expected_um = np.empty_like(commands_um)
    for k, values_um in enumerate(np.hstack([rest, references_um])):
        expected_um[k] = system.c @ states + system.d @ values_um
        states = system.a @ states + system.b @ values_um
    if not np.all(np.abs(commands_um - expected_um) <= PROPORTIONAL * reference_um + 1e-6 * np.abs(expected_um).max()):
        raise ValueError(
            f"for references of {reference_um:.3g} µm, the command is not in the proportion that it has near 0 µm"
        )
    without_um, with_um = tick.run(errors_um, rest), tick.run(errors_um, references_um) - commands_um
    if not np.all(np.abs(with_um - without_um) <= PROPORTIONAL * np.abs(without_um).max() + 1e-3 * PROPORTIONAL * STEP):
        raise ValueError(f"at references of {reference_um:.3g} µm, an error gives another command than near 0 µm")


def _test_signals(axes: int) -> Real:
    """Return signals (REFERENCE_TICKS, axes) within ±1: steps up and down and a rise, for each axis at other ticks."""
    ticks = np.arange(REFERENCE_TICKS)
    signal = np.select([ticks < 30, ticks < 60, ticks < 90], [1.0, -1.0, ticks / 30.0 - 2.0], 0.4)
    return np.stack([np.roll(signal, 17 * axis) for axis in range(axes)], axis=1)


def _command_without_error(law: Controller, reach_um: float, reason: str) -> str:
    """Return the reason why the response to the reference is not known if the law, which has no linearisation, responds
    to references of `reach_um` at errors of 0; else "".
    """
    tick = _Tick(law)
    references_um = reach_um * _test_signals(tick.axes)
    try:
        with np.errstate(all="ignore"):
            commands_um = tick.run(np.zeros_like(references_um), references_um)
    except (ArithmeticError, IndexError, ValueError) as error:
        return f"{_place(error, type(law))}{error}"
    return reason if not np.all(np.abs(commands_um) <= 1e-9 * reach_um) else ""


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


def _derivatives(tick: _Tick, step: float, columns: range) -> Real:
    """Return the derivatives (n + m, columns), from differences of ±`step` about rest.

    A row is a next state (n) or a command (m), a column a state (n), an error (m) or a reference (m), by its number.
    """
    matrix = np.zeros((tick.size + tick.axes, len(columns)))
    for place, column in enumerate(columns):
        point = np.zeros(tick.size + 2 * tick.axes)
        point[column] = step
        matrix[:, place] = (tick(point) - tick(-point)) / (2 * step)
    return matrix


class _Tick:
    """Function from states (n,), errors and references (m,) to next states and commands: one tick, uncompiled."""

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

    def __call__(self, point: Real) -> Real:
        """Run one tick and return the next states, then the commands (n + m,).

        `point` (n + 2 m,) has the values of all fields of type float, in the order of the record, then errors and
        references in µm. Other states are 0.
        """
        self._state.view(np.uint8)[:] = 0
        offset = 0
        for name in self._fields:
            target = self._state[name].reshape(-1)
            target[:] = point[offset : offset + target.size]
            offset += target.size
        commands_um = self._commands(*point[offset:].reshape(2, self.axes))
        return np.concatenate([*(self._state[name].reshape(-1) for name in self._fields), commands_um])

    def run(self, errors_um: Real, references_um: Real) -> Real:
        """Run a tick for each row of `errors_um` and `references_um` (ticks, m), from states of 0; return the commands
        (ticks, m).
        """
        self._state.view(np.uint8)[:] = 0
        return np.array([self._commands(*row) for row in zip(errors_um, references_um, strict=True)])

    def _commands(self, errors_um: Real, references_um: Real) -> Real:
        """Run one tick from the present states, with positions that have these errors; return the commands (m,)."""
        control = new_records(self._signals, 1)
        control.reference_um, control.position_um, control.error_um = (
            references_um,
            references_um - errors_um,
            errors_um,
        )
        state = self._state[0]
        returned = self._output(self._coefficients, state, control[0])
        if self.axes == 1:
            control.command_um = returned
        control.applied_um = control.command_um
        self._update(self._coefficients, state, control[0])
        return control.command_um.reshape(-1).copy()


def python_function(function: Any) -> Callable[..., Any]:
    """Return the Python function of a kernel, or a Python function itself."""
    return getattr(function, "py_func", function)

"""Conformance suite of laws: tests of all that the loop relies on, to be inherited by a law's own test class.

    from rtloop.laws.conformance import LawConformance

    class TestMine(LawConformance):
        law = Mine(MineOptions(gain=2.0), 1e-4, None)

Then run pytest on it. No hardware is involved: the functions are called on records alone."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pytest

from rtloop.foundation.arrays import Complex
from rtloop.foundation.native.compiled import UNCOMPILED, Kernel, jit_strict
from rtloop.kernel.layout import MAX_EXTRAS, control_dtype
from rtloop.kernel.memory import new_records
from rtloop.laws.binding import function_signatures
from rtloop.laws.contract import Controller, Law, build_record
from rtloop.laws.limited_return import SATURATED, LimitedLoop, dc_gains
from rtloop.laws.linearise import python_function
from rtloop.laws.measured_response import measure_response
from rtloop.laws.purity import foreign_calls

if TYPE_CHECKING:
    from numba.core.typing.templates import Signature

TICKS, SEED = 400, 7
COST_TICKS = 4_000
SETTLING_TICKS = 2_000
REACH_UM = 60.0
BUMP = 1e-6
"""Allowed deviation of the first command after `enter`, as a fraction of 1 µm + |command| + |error|."""
ROUNDING = 1e-14
"""Error of the applied command, as a fraction of the command."""
EXTRA_SHARE, EXTRA_TICKS, EXTRA_OVERSHOOT = 0.15, 5, 0.2
"""Allowance for the return from a limit against the return without one: extra time as a fraction and in ticks, and
extra overshoot as a fraction of the way."""


class LawConformance:
    """Base class of a law's tests. Set `law` to an instance with the options of a user.

    A law whose memory lasts longer than its loop's settling time sets `saturated_ticks` to the length of that
    memory."""

    law: Law
    saturated_ticks = 0

    def frequency_response(self, frequencies_hz: npt.ArrayLike, amplitude_um: float = 1.0) -> Complex:
        """Return the controller's frequency response from error to command, (frequencies,), for tests of one's own.

        The law's functions run as in the loop, without a limit of the command. The reference is 0, the error a sine,
        the position −error. NUMBA_DISABLE_JIT=1 runs them uncompiled. For several axes the shape is (frequencies, axes,
        axes), with commands as rows and errors as columns. Raises ValueError for a feedforward, for a frequency that is
        not above 0 and below half of the rate, and for a response that does not settle.
        """
        if self.law.count == 0:
            raise ValueError(
                "this law is a feedforward; only a controller has a frequency response from error to command"
            )
        return Bench(self.law).frequency_response(frequencies_hz, amplitude_um)

    @pytest.fixture
    def bench(self) -> Bench:
        """Return a Bench of the law: its functions, compiled except with NUMBA_DISABLE_JIT=1, and their own records."""
        return Bench(self.law)

    def test_build_gives_finite_numbers(self) -> None:
        """Every coefficient is finite, and the same options give the same bytes."""
        built = build_record(self.law)
        for name in built.dtype.names or ():
            assert np.all(np.isfinite(built[name].astype(float))), f"coefficient {name} is not finite: {built[name]}"
        assert built.tobytes() == build_record(self.law).tobytes(), (
            "two builds with the same options gave different coefficients"
        )

    def test_whole_numbers_are_bounded(self) -> None:
        """Each whole number of the records, and no other field, has its allowed values in `allowed_coefficients` or
        `allowed_state`."""
        law_records = self.law.records(self.law.count)
        for kind, allowed in (("coefficients", law_records.allowed_coefficients), ("state", law_records.allowed_state)):
            table = getattr(law_records, kind)
            integer_fields = {
                name for name in table.names if table[name].base.kind in "iu" and name not in ("unused", "reserved")
            }
            assert set(allowed) == integer_fields, (
                f"allowed_{kind} has the keys {', '.join(sorted(allowed)) or 'none'}; allowed: the integers of the "
                f"record, {', '.join(sorted(integer_fields)) or 'none'}"
            )

    def test_compiled_and_uncompiled_give_the_same_bits(self, bench: Bench) -> None:
        """Compiled and uncompiled functions give the same bits of results, state and extra outputs, over ticks with
        extreme errors and limited commands. Skipped with NUMBA_DISABLE_JIT=1."""
        _require_compiler()
        uncompiled = Bench(self.law, compiled=False)
        for number, (tick_compiled, tick_uncompiled) in enumerate(
            zip(bench.run(TICKS), uncompiled.run(TICKS), strict=True)
        ):
            assert tick_compiled == tick_uncompiled, (
                f"tick {number}: the compiled law gives {tick_compiled}, the uncompiled law {tick_uncompiled}"
            )

    def test_its_state_is_in_its_record(self, bench: Bench) -> None:
        """Runs from the same state bytes are equal, compiled or not: there is no memory outside the record."""
        for tested in (bench, Bench(self.law, compiled=False)):
            list(tested.run(TICKS))
            saved_state = tested.state.copy()
            first = list(tested.run(TICKS, SEED + 1))
            tested.state[:] = saved_state
            assert list(tested.run(TICKS, SEED + 1)) == first, (
                "two runs from the same state and inputs gave different results"
            )

    def test_its_coefficients_are_read_only(self, bench: Bench) -> None:
        """No function writes to the coefficients: a recording describes the law by them."""
        before = bench.coefficients.tobytes()
        list(bench.run(TICKS))
        assert bench.coefficients.tobytes() == before, (
            "a function of the law wrote to the coefficients, which are read-only"
        )

    def test_it_stays_finite(self, bench: Bench) -> None:
        """Bounded inputs give bounded results: a command, or the sum of a feedforward's drive (V) and its command (µm),
        has a magnitude below 1e9."""
        for number, (value, _) in enumerate(bench.run(20 * TICKS, wild=False)):
            assert np.all(np.abs(value) < 1e9), f"tick {number}: the output is {value}; allowed: magnitudes below 1e9"

    def test_no_number_that_is_none_outlives_an_entry(self, bench: Bench) -> None:
        """All results are finite again after NaN and infinite inputs: a controller's after a new entry, a feedforward's
        at once."""
        bench.poison()
        bench.enter(*np.multiply.outer([3.0, 1.0, 5.0], np.ones(max(self.law.count, 1))))
        for number, (value, _) in enumerate(bench.run(TICKS, wild=False)):
            assert np.all(np.isfinite(value)), (
                f"tick {number} after a call of `enter`: the output is {value}; allowed: finite numbers"
            )

    def test_enter_continues_from_the_command(self, bench: Bench) -> None:
        """The first command after `enter` differs from the command before by at most BUMP · (1 µm + |command| +
        |error|).

        Skipped for a feedforward, and for a controller without `enter`, to whose command the loop adds an offset."""
        if not isinstance(self.law, Controller) or type(self.law).enter is None:
            pytest.skip("the law does not define `enter`")
        random = np.random.default_rng(SEED)
        for _ in range(50):
            position_um, error_um, command_um = random.uniform(-REACH_UM, REACH_UM, (3, self.law.count))
            first_um = bench.enter(position_um, error_um, command_um)
            room = BUMP * (1 + np.abs(command_um) + np.abs(error_um))
            assert np.all(np.abs(first_um - command_um) <= room), (
                f"after `enter` with a command of {command_um} µm the first output is {first_um} µm; allowed: about "
                "the same command"
            )

    def test_a_limited_command_does_not_wind_it_up(self, bench: Bench) -> None:
        """The loop returns from a long limit about as fast as from rest, with about the same overshoot.

        The plant of `rtloop.laws.limited_return` is used: a lag with the gain of the law's model, or 1. The law passes
        if it returns from a reference or from a load. Skipped for a feedforward, and where the loop does not return
        from rest without a limit."""
        if not isinstance(self.law, Controller):
            pytest.skip("a feedforward has no loop")
        faults = [fault for by_load in (False, True) if (fault := self._windup(bench, by_load)) is not None]
        if not faults:
            pytest.skip(
                "the loop of the law and a lag, which has the gain of the law's model or 1, does not return to its "
                "reference even without a limit"
            )
        assert "" in faults, faults[0]

    def test_a_rounding_error_of_the_applied_command_stops_nothing(self, bench: Bench) -> None:
        """The loop returns as fast where the applied command differs from the command by a rounding error.

        A loop's applied command comes back through the feedforward, and so has such an error without any limit. The
        plant and the skipped laws are those of the test for windup."""
        if not isinstance(self.law, Controller):
            pytest.skip("a feedforward has no loop")
        exact = bench.limited_loop(False, at_rest=True).unlimited_return()
        if exact is None:
            pytest.skip("the loop of the law and a lag does not return to its reference even without a rounding error")
        bench.rounding = ROUNDING
        rounded = bench.limited_loop(False, at_rest=True).unlimited_return()
        most_ticks = int((1 + EXTRA_SHARE) * exact.ticks) + EXTRA_TICKS
        ticks = math.inf if rounded is None else rounded.ticks
        assert ticks <= most_ticks, (
            "the law takes a rounding error of the applied command for a limit: with applied_um = command_um "
            f"(1 ± {ROUNDING:g}) the loop did not return to its reference in {most_ticks} ticks; with applied_um = "
            f"command_um it returns in {exact.ticks} ticks; compare them with a tolerance, such as 1e-9 µm"
        )

    def _windup(self, bench: Bench, by_load: bool) -> str | None:
        """Return a text if the law winds up, "" if it does not, None if its loop does not return without a limit."""
        free = bench.limited_loop(by_load, at_rest=True).unlimited_return()
        if free is None:
            return None
        most_ticks = int((1 + EXTRA_SHARE) * free.ticks) + EXTRA_TICKS
        saturated_ticks = max(SATURATED * free.ticks, self.saturated_ticks)
        limited = bench.limited_loop(by_load).limited_return(saturated_ticks, most_ticks)
        if limited is None:
            return (
                f"the law winds up: after {saturated_ticks} ticks at the command's limit, the loop did not return to "
                f"its reference in {most_ticks} ticks; without a limit it returns in {free.ticks} ticks"
            )
        if limited.overshoot > free.overshoot + EXTRA_OVERSHOOT:
            return (
                f"the law winds up: after the command's limit, the loop overshot by {100 * limited.overshoot:.1f} % of "
                f"the way; without a limit it overshoots by {100 * free.overshoot:.1f} %"
            )
        return ""

    def test_it_calls_nothing_that_waits_or_differs(self, bench: Bench) -> None:
        """No function allocates, prints, calls the interpreter, or uses mathematics that differs between processors.

        Skipped with NUMBA_DISABLE_JIT=1."""
        _require_compiler()
        for name, calls in bench.calls_by_function():
            assert not calls, f"{name}: " + "; ".join(f"{called} {reason}" for called, reason in calls.items())

    def test_what_a_tick_costs(self, bench: Bench, record_property: Callable[[str, object], None]) -> None:
        """Record `ns_per_tick`, the mean time of a tick whose functions are called from Python, for comparison between
        laws; no limit is tested."""
        began_ns = time.perf_counter_ns()
        deque = [value for value, _ in bench.run(COST_TICKS)]
        record_property("ns_per_tick", (time.perf_counter_ns() - began_ns) / COST_TICKS)
        assert len(deque) == COST_TICKS


def _require_compiler() -> None:
    """Skip the test where the functions run uncompiled."""
    if UNCOMPILED:
        pytest.skip("NUMBA_DISABLE_JIT is set: nothing is compiled")


@cache
def _compiled(function: Callable[..., object], signature: Signature) -> Kernel:
    """Return a kernel of `function` compiled for this signature, with checked indices and divisions."""
    kernel = jit_strict(function)
    kernel.compile(signature)
    return kernel


class Bench:
    """A law's functions with their own records, compiled as in the loop or uncompiled."""

    def __init__(self, law: Law, compiled: bool = not UNCOMPILED) -> None:
        """Build the law's coefficients, a state of zeros, and its functions, which are compiled if `compiled`."""
        law_records, self._law = law.records(law.count), law
        self.rounding = 0.0
        """Error of the applied command in `limited_loop`, relative to the command, with another sign in each tick."""
        self.coefficients = new_records(law_records.coefficients, 1)
        self.coefficients[:] = build_record(law)
        self.state = new_records(law_records.state, 1)
        self._control: Any = new_records(control_dtype(law.count), 1) if law.count else None
        self._rows = (self.coefficients[0], self.state[0])
        self._kernels: dict[str, Any] = {}
        self._signatures = function_signatures(type(law), law_records)
        for name, signature in self._signatures.items():
            python_kernel = python_function(getattr(type(law), name))
            self._kernels[name] = _compiled(python_kernel, signature) if compiled else python_kernel

    def _call(self, name: str, law_input: Any) -> Any:
        """Call function `name` with coefficients, state and `law_input`, without floating-point warnings; return its
        result.
        """
        with np.errstate(all="ignore"):
            return self._kernels[name](*self._rows, law_input)

    def run(self, ticks: int, seed: int = SEED, wild: bool = True) -> Iterator[tuple[float | tuple[float, ...], bytes]]:
        """Run `ticks` ticks with random signals; yield for each (result, bytes of the state and, of a controller, of
        the extra outputs).

        The result is the command in µm (for several axes a tuple), or the sum of a feedforward's drive in V and its
        command in µm. The applied command is limited to ±REACH_UM. If `wild`, every 97th tick of a controller has
        positions and references up to 1e6 µm.
        """
        random = np.random.default_rng(seed)
        for number in range(ticks):
            if self._law.count == 0:
                value = float(self._call("output", random.uniform(-REACH_UM, REACH_UM)))
                followed = float(self._call("update", random.uniform(-10, 10)))
                yield value + followed, self.state.tobytes()
                continue
            control = self._control[0]
            reach = 1e6 if wild and number % 97 == 0 else REACH_UM
            axes = None if self._law.count == 1 else self._law.count
            position_um, reference_um = random.uniform(-reach, reach, axes), random.uniform(-reach, reach, axes)
            control["position_um"], control["reference_um"] = position_um, reference_um
            control["error_um"] = reference_um - position_um
            control["command_um"] = control["applied_um"] = random.uniform(-REACH_UM, REACH_UM, axes)
            control["inputs"], control["outputs"] = random.uniform(-10, 10, MAX_EXTRAS), 0.0
            value = self._commands(control)
            control["command_um"], control["applied_um"] = value, np.clip(value, -REACH_UM, REACH_UM)
            self._call("update", control)
            yield value, self.state.tobytes() + control["outputs"].tobytes()

    def _commands(self, control: np.record) -> float | tuple[float, ...]:
        """Call the controller's `output` with `control`; return its command, µm: a number, or a tuple (axes,)."""
        value = self._call("output", control)
        return float(value) if self._law.count == 1 else tuple(control.command_um.tolist())

    def poison(self) -> None:
        """Call `output`, and a controller's `update`, with NaN, +inf and −inf as all inputs, and ignore the results.

        An ArithmeticError, IndexError or ValueError is ignored too.
        """
        for value in (np.nan, np.inf, -np.inf):
            try:
                if self._law.count == 0:
                    self._call("output", value)
                    continue
                for name in self._control.dtype.names:
                    self._control[name] = value
                self._call("output", self._control[0])
                self._call("update", self._control[0])
            except (ArithmeticError, IndexError, ValueError):
                continue

    def enter(self, position_um: Any, error_um: Any, command_um: Any) -> Any:
        """Enter a controller as the loop does, from a state of zeros; return the commands of its first tick.

        The arguments are (axes,), the commands a number or, for several axes, a tuple, all in µm. A controller without
        `enter` keeps its state of zeros. The result for a feedforward is 0, and no function is called.
        """
        if self._law.count == 0:
            return 0.0
        self.state.view(np.uint8)[:] = 0
        control = self._control[0]
        if self._law.count == 1:
            position_um, error_um, command_um = float(position_um[0]), float(error_um[0]), float(command_um[0])
        control.position_um, control.error_um, control.reference_um = position_um, error_um, position_um + error_um
        control.command_um = control.applied_um = command_um
        if "enter" in self._kernels:
            self._call("enter", control)
        return self._commands(control)

    def frequency_response(self, frequencies_hz: npt.ArrayLike, amplitude_um: float) -> Complex:
        """Return the response of `LawConformance.frequency_response` for a controller; raise ValueError as it does."""
        count, rest_um = self._law.count, np.zeros(self._law.count)
        response = measure_response(
            lambda error_um: self._limited_tick(-error_um, rest_um, np.inf),
            lambda: self.enter(rest_um, rest_um, rest_um),
            count, self._law.period_s, frequencies_hz, amplitude_um,
        )  # fmt: skip
        return response[:, 0, 0] if count == 1 else response

    def limited_loop(self, by_load: bool, at_rest: bool = False) -> LimitedLoop:
        """Return the loop of the law and a plant with a lag, at the position that a command of REACH_UM holds.

        `by_load` is that of LimitedLoop. `enter` of the law is called at this position without an error. A law that
        lacks `enter` begins from a state of zeros; if `at_rest`, it then runs for SETTLING_TICKS with this position as
        reference and no limit of the command.
        """
        count = self._law.count
        loop = LimitedLoop(self._limited_tick, dc_gains(self._law.model, count), REACH_UM, by_load)
        self.enter(0 * loop.edge_um if by_load else loop.edge_um, np.zeros(count), np.full(count, REACH_UM))
        if at_rest and "enter" not in self._kernels:
            loop.follow(loop.edge_um, SETTLING_TICKS, limited=False)
        return loop

    def _limited_tick(self, position_um: Any, reference_um: Any, limit_um: float) -> Any:
        """Run one tick with the command limited to ±`limit_um`; return the applied commands (axes,), in µm.

        `position_um` and `reference_um` are (axes,). The state advances.
        """
        control = self._control[0]
        if self._law.count == 1:
            position_um, reference_um = float(position_um[0]), float(reference_um[0])
        control.position_um, control.reference_um, control.error_um = (
            position_um,
            reference_um,
            reference_um - position_um,
        )
        control.inputs, control.outputs = 0.0, 0.0
        value = self._commands(control)
        control.command_um, control.applied_um = value, (1 + self.rounding) * np.clip(value, -limit_um, limit_um)
        self.rounding = -self.rounding
        self._call("update", control)
        return np.atleast_1d(np.array(control.applied_um))

    def calls_by_function(self) -> Iterator[tuple[str, dict[str, str]]]:
        """Yield each compiled function's name and its forbidden calls, as a mapping from callee to reason."""
        for name, kernel in self._kernels.items():
            yield name, foreign_calls(kernel, self._signatures[name], self._law.libm)

"""The conformance suite of laws: what the loop relies on, as tests that a law's own suite inherits.

    from rtloop.laws.conformance import LawConformance

    class TestMine(LawConformance):
        law = Mine(MineOptions(gain=2.0), 1e-4, None)

Then run pytest on it. Nothing is driven: the functions are called on records alone.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from rtloop.hil.native.compiled import jit_strict
from rtloop.law.layout import MAX_EXTRAS, control_dtype
from rtloop.law.memory import new_records
from rtloop.laws.binding import function_signatures
from rtloop.laws.contract import Controller, Law, build_record
from rtloop.laws.limited_return import SATURATED, LimitedLoop, dc_gains
from rtloop.laws.linearise import python_function
from rtloop.laws.purity import foreign_calls

TICKS, SEED = 400, 7
COST_TICKS = 4_000
SETTLING_TICKS = 2_000
REACH_UM = 60.0
BUMP = 1e-6
"""Of the command that a law is told to go on from, and of the error that it meets."""
EXTRA_SHARE, EXTRA_TICKS, EXTRA_OVERSHOOT = 0.15, 5, 0.2
"""By how much the return from a limit may take longer than without one, as a part and in ticks; by which part of the
way it may overshoot further."""


class LawConformance:
    """Set `law`: an instance, with options as a user would give them.

    A law whose memory is longer than its loop's settling time sets `saturated_ticks` to that.
    """

    law: Law
    saturated_ticks = 0

    @pytest.fixture
    def bench(self) -> Bench:
        """The law on records of its own."""
        return Bench(self.law)

    def test_build_gives_finite_numbers(self) -> None:
        """Every coefficient is finite, and the same options give the same bytes."""
        built = build_record(self.law)
        for name in built.dtype.names or ():
            assert np.all(np.isfinite(built[name].astype(float))), f"coefficient {name} is not finite: {built[name]}"
        assert built.tobytes() == build_record(self.law).tobytes(), "the same options gave other coefficients"

    def test_whole_numbers_are_bounded(self) -> None:
        """Whatever the functions use as an index has its range in `allowed_coefficients` and `allowed_state`."""
        law_records = self.law.records(self.law.count)
        for kind, allowed in (("coefficients", law_records.allowed_coefficients), ("state", law_records.allowed_state)):
            table = getattr(law_records, kind)
            integer_fields = {
                name for name in table.names if table[name].base.kind in "iu" and name not in ("unused", "reserved")
            }
            assert set(allowed) == integer_fields, (
                f"allowed_{kind} must name {sorted(integer_fields)}; it names {sorted(allowed)}"
            )

    def test_compiled_and_uncompiled_give_the_same_bits(self, bench: Bench) -> None:
        """Results and state, over ticks with wild errors and limited commands."""
        uncompiled = Bench(self.law, compiled=False)
        for number, (tick_compiled, tick_uncompiled) in enumerate(
            zip(bench.run(TICKS), uncompiled.run(TICKS), strict=True)
        ):
            assert tick_compiled == tick_uncompiled, (
                f"tick {number}: compiled {tick_compiled}, uncompiled {tick_uncompiled}"
            )

    def test_its_state_is_in_its_record(self, bench: Bench) -> None:
        """From the same bytes it goes on the same, compiled or not: nothing is remembered anywhere else."""
        for tested in (bench, Bench(self.law, compiled=False)):
            list(tested.run(TICKS))
            saved_state = tested.state.copy()
            first = list(tested.run(TICKS, SEED + 1))
            tested.state[:] = saved_state
            assert list(tested.run(TICKS, SEED + 1)) == first, "from the same state it went on otherwise"

    def test_its_coefficients_are_read_only(self, bench: Bench) -> None:
        """They are what a recording says of the law."""
        before = bench.coefficients.tobytes()
        list(bench.run(TICKS))
        assert bench.coefficients.tobytes() == before, "a function wrote to its coefficients"

    def test_it_stays_finite(self, bench: Bench) -> None:
        """Bounded errors and commands that are applied give commands that are numbers, far from the end of numbers."""
        for number, (value, _) in enumerate(bench.run(20 * TICKS, wild=False)):
            assert np.all(np.abs(value) < 1e9), f"tick {number}: {value}"

    def test_no_number_that_is_none_outlives_an_entry(self, bench: Bench) -> None:
        """After NaN and infinity, entered anew, it works."""
        bench.poison()
        bench.enter(*np.multiply.outer([3.0, 1.0, 5.0], np.ones(max(self.law.count, 1))))
        for number, (value, _) in enumerate(bench.run(TICKS, wild=False)):
            assert np.all(np.isfinite(value)), f"tick {number} after the entry: {value}"

    def test_enter_continues_from_the_command(self, bench: Bench) -> None:
        """Its `enter` leaves no more than BUMP; without one the loop's own offset does it."""
        if not isinstance(self.law, Controller) or type(self.law).enter is None:
            pytest.skip("the law has no enter of its own")
        random = np.random.default_rng(SEED)
        for _ in range(50):
            position_um, error_um, command_um = random.uniform(-REACH_UM, REACH_UM, (3, self.law.count))
            first_um = bench.enter(position_um, error_um, command_um)
            room = BUMP * (1 + np.abs(command_um) + np.abs(error_um))
            assert np.all(np.abs(first_um - command_um) <= room), f"told to go on at {command_um}, it gave {first_um}"

    def test_a_limited_command_does_not_wind_it_up(self, bench: Bench) -> None:
        """After a limit was long in force, the loop comes back as soon as from rest, and overshoots no further.

        The loop is that of `rtloop.laws.limited_return`: a lag with the gain of the law's model, or 1.
        """
        if not isinstance(self.law, Controller):
            pytest.skip("a feedforward has no loop")
        free = bench.limited_loop(at_rest=True).unlimited_return()
        if free is None:
            pytest.skip("without a limit its loop around a lag with the gain of its model, or 1, does not come back")
        most_ticks = int((1 + EXTRA_SHARE) * free.ticks) + EXTRA_TICKS
        saturated_ticks = max(SATURATED * free.ticks, self.saturated_ticks)
        limited = bench.limited_loop().limited_return(saturated_ticks, most_ticks)
        assert limited is not None, (
            f"wound up: {saturated_ticks} ticks beyond the limit, and it was not back after {most_ticks} ticks; "
            f"it takes {free.ticks} without a limit"
        )
        assert limited.overshoot <= free.overshoot + EXTRA_OVERSHOOT, (
            f"wound up: back from the limit it overshot by {100 * limited.overshoot:.1f} % of the way; "
            f"without a limit by {100 * free.overshoot:.1f} %"
        )

    def test_it_calls_nothing_that_waits_or_differs(self, bench: Bench) -> None:
        """No memory taken, nothing printed, no interpreter, no mathematics that differs between processors."""
        for name, calls in bench.calls_by_function():
            assert not calls, f"{name}: " + "; ".join(f"{called} {reason}" for called, reason in calls.items())

    def test_what_a_tick_costs(self, bench: Bench, record_property: Any) -> None:
        """Noted as `ns_per_tick`, called from Python: to compare laws, and no verdict."""
        began_ns = time.perf_counter_ns()
        deque = [value for value, _ in bench.run(COST_TICKS)]
        record_property("ns_per_tick", (time.perf_counter_ns() - began_ns) / COST_TICKS)
        assert len(deque) == COST_TICKS


@cache
def _compiled(function: Any, signature: Any) -> Any:
    kernel = jit_strict(function)
    kernel.compile(signature)
    return kernel


class Bench:
    """A law's functions on records of its own, compiled as the loop has them or as they are written."""

    def __init__(self, law: Law, compiled: bool = True) -> None:
        law_records, self._law = law.records(law.count), law
        self.coefficients: Any = new_records(law_records.coefficients, 1)
        self.coefficients[:] = build_record(law)
        self.state: Any = new_records(law_records.state, 1)
        self._control: Any = new_records(control_dtype(law.count), 1) if law.count else None
        self._rows = (self.coefficients[0], self.state[0])
        self._kernels: dict[str, Any] = {}
        self._signatures = function_signatures(type(law), law_records)
        for name, signature in self._signatures.items():
            python_kernel = python_function(getattr(type(law), name))
            self._kernels[name] = _compiled(python_kernel, signature) if compiled else python_kernel

    def _call(self, name: str, law_input: Any) -> Any:
        with np.errstate(all="ignore"):
            return self._kernels[name](*self._rows, law_input)

    def run(self, ticks: int, seed: int = SEED, wild: bool = True) -> Iterator[tuple[Any, bytes]]:
        """What each tick gives, a number or one for each axis, and the state and the outputs after it."""
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

    def _commands(self, control: Any) -> Any:
        """What the controller commands: a number, or a tuple with one for each of its axes."""
        value = self._call("output", control)
        return float(value) if self._law.count == 1 else tuple(control.command_um.tolist())

    def poison(self) -> None:
        """Ticks with what is no number; what it returns or raises then is its own affair."""
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
        """As the loop lets a controller in, from a state of zeros; the commands of its first tick. All (axes,)."""
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

    def limited_loop(self, at_rest: bool = False) -> LimitedLoop:
        """The law at the edge of what the limit can hold; without `enter` it rests there if `create_at_rest`."""
        count = self._law.count
        loop = LimitedLoop(self._limited_tick, dc_gains(self._law.model, count), REACH_UM)
        self.enter(loop.edge_um, np.zeros(count), np.full(count, REACH_UM))
        if at_rest and "enter" not in self._kernels:
            loop.follow(loop.edge_um, SETTLING_TICKS, limited=False)
        return loop

    def _limited_tick(self, position_um: Any, reference_um: Any, limit_um: float) -> Any:
        """One tick with a limit of the command; what was applied. All (axes,)."""
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
        control.command_um, control.applied_um = value, np.clip(value, -limit_um, limit_um)
        self._call("update", control)
        return np.atleast_1d(np.array(control.applied_um))

    def calls_by_function(self) -> Iterator[tuple[str, dict[str, str]]]:
        """Of each function what it calls that a law may not."""
        for name, kernel in self._kernels.items():
            yield name, foreign_calls(kernel, self._signatures[name], self._law.libm)

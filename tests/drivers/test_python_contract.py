"""A driver in plain Python keeps the contract; a driver that breaks any promise of the contract fails the suite."""

from __future__ import annotations

import ast
import math
import traceback
from collections.abc import Sequence
from pathlib import Path

import pytest

from rtloop.drivers import contract
from rtloop.drivers.contract import DriverCalls
from rtloop.drivers.errors import DriverError
from rtloop.engine.plan import require_facts
from tests.drivers.bench_driver import LoopBack, LoopBackContract
from tests.drivers.mutants import MUTANTS, Native


class TestLoopBack(LoopBackContract):
    pass


class TestNative(LoopBackContract):
    kind = Native


def failed_tests(mutant: type[LoopBack]) -> list[tuple[str, int]]:
    """Return the tests that fail for a mutant, each with the line of the contract's assertion, 0 for another error."""
    suite = type("Suite", (LoopBackContract,), {"kind": mutant})
    failures = []
    for name in dir(suite):
        if name.startswith("test_"):
            try:
                getattr(suite(), name)()
            except AssertionError as error:
                lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == contract.__file__]
                failures.append((name, lines[-1] or 0))
            except (DriverError, ValueError):
                failures.append((name, 0))
    return failures


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_broken_promise_fails_the_suite(mutant):
    assert failed_tests(MUTANTS[mutant])


def test_every_promise_is_broken_by_a_mutant():
    """Each assertion of the suite fails for at least one mutant."""
    tree = ast.parse(Path(contract.__file__).read_text())
    assertions = {node.lineno: ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Assert)}
    failed_lines = {line for mutant in MUTANTS.values() for _, line in failed_tests(mutant)}
    assert [text for line, text in assertions.items() if line not in failed_lines] == []


@pytest.mark.parametrize(
    ("mutant", "test", "message"),
    [
        ("DeafAfterClose", "test_open_after_close", "OSError: no answer"),
        ("MuteAfterClose", "test_open_after_close", "OSError: no answer"),
        ("RefusesTheEndOfItsRange", "test_write_accepts_the_whole_range", "ValueError: too much"),
    ],
)
def test_a_failure_shows_the_exception_of_the_driver(mutant, test, message):
    suite = type("Suite", (LoopBackContract,), {"kind": MUTANTS[mutant]})
    with pytest.raises(AssertionError, match=message):
        getattr(suite(), test)()


def open_driver(driver: LoopBack) -> tuple[LoopBack, DriverCalls]:
    """Open a driver and return it with its calls."""
    return driver, DriverCalls(driver.open(), driver.facts)


def test_an_exception_in_read_is_a_failed_driver_and_is_stored():
    driver, calls = open_driver(LoopBack())
    driver.volts = ["not a number", 0.0]  # type: ignore[list-item]
    assert calls.read()[0] == -1
    assert isinstance(driver.error, TypeError)


@pytest.mark.parametrize("volts", [[5.1, 2.0], [0.0, -0.1], [math.nan, 2.0], [0.0, math.inf]])
def test_an_output_outside_its_range_is_refused_with_a_message(volts):
    driver, calls = open_driver(LoopBack())
    assert calls.write([1.0, 3.0]) == 0
    assert calls.write(volts) == -1
    assert driver.volts == [1.0, 3.0]
    assert "V; allowed: " in str(driver.error)


def test_a_wrong_number_of_inputs_is_refused_with_a_message():
    driver, calls = open_driver(MUTANTS["ForgetsAnInput"]())
    assert calls.read()[0] == -1
    assert str(driver.error) == (
        "driver 'loopback': the methods `read` and `observe` together returned 2 numbers; allowed: 3, one for each "
        "input and each observed signal in `facts`"
    )


def test_an_output_that_cannot_be_parked_is_an_error():
    class Broken(LoopBack):
        stopped = False

        def write(self, volts: Sequence[float]) -> None:
            raise OSError("no such device")

        def stop(self) -> None:
            self.stopped = True

    driver = Broken()
    driver.open()
    text = r"'loopback': the outputs could not be made safe \(no such device\) and may still carry voltage; check"
    with pytest.raises(DriverError, match=text):
        driver.close()
    assert driver.stopped
    driver.close()


def test_a_rate_above_the_limit_and_virtual_time_on_real_hardware_are_refused():
    with pytest.raises(ValueError, match=r"loop\.rate_hz: 2001 Hz; allowed with driver 'loopback': at most 2000 Hz"):
        require_facts(LoopBack(), 2001.0, True)
    with pytest.raises(ValueError, match="driver 'loopback' moves real hardware and cannot run in virtual time"):
        require_facts(LoopBack(), 1000.0, False)
    assert require_facts(LoopBack(), 2000.0, True) == LoopBack().facts

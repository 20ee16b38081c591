"""The conformance suite passes a correct law; each mutant fails the test of the promise that it breaks."""

from __future__ import annotations

import inspect
from typing import Any

import pytest
from _pytest.outcomes import Failed
from numba.core.errors import NumbaError

from rtloop.laws import ControllerOptions
from rtloop.laws.conformance import Bench, LawConformance
from tests.laws.mutants import BROKEN, CORRECT

TESTS = [name for name in vars(LawConformance) if name.startswith("test_")]


def failure_message(kind: type[Any], name: str) -> str | None:
    """Return the failure message of a test of the suite for a law; None if it passes."""
    suite = LawConformance()
    suite.law = kind(ControllerOptions(), 1e-4, None)
    fixtures = {"record_property": lambda *_: None}
    try:
        if "bench" in inspect.signature(getattr(suite, name)).parameters:
            fixtures["bench"] = Bench(suite.law)
        expected = inspect.signature(getattr(suite, name)).parameters
        getattr(suite, name)(**{key: value for key, value in fixtures.items() if key in expected})
    except (AssertionError, Failed, ArithmeticError, NumbaError) as error:
        return str(error) or type(error).__name__
    return None


@pytest.mark.parametrize("name", TESTS)
@pytest.mark.parametrize("kind", CORRECT)
def test_a_law_that_keeps_them_all_passes(kind, name):
    assert failure_message(kind, name) is None


@pytest.mark.parametrize(("kind", "name"), BROKEN.items(), ids=[kind.__name__ for kind in BROKEN])
def test_a_mutant_fails_where_it_breaks_its_promise(kind, name):
    assert failure_message(kind, name) is not None

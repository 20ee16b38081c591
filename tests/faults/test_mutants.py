"""The mistakes that `make soak NAME=fault-mutants` plants are still mistakes of the code as it is."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from tests.faults.mutants import MUTANTS, Mutant


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_the_text_to_be_replaced_is_there_once(mutant: Mutant) -> None:
    found = importlib.util.find_spec(mutant.module)
    assert found is not None
    assert found.origin is not None
    assert Path(found.origin).read_text().count(mutant.old) == 1

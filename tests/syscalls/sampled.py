"""A sample of what `make soak-syscalls` tries: killed and failing at a system call, judged by the next hand.

python -m pytest tests/syscalls/sampled.py
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.syscalls.components import COMPONENTS, surroundings
from tests.syscalls.mutants import MUTANTS, Mutant
from tests.syscalls.sampling import plan, sample
from tests.syscalls.traced import unavailable

SAMPLE = 200
pytestmark = pytest.mark.skipif(bool(unavailable()), reason=unavailable())
SHARES = sum(component.share for component in COMPONENTS.values())


@pytest.fixture(autouse=True)
def _surroundings() -> Iterator[None]:
    with surroundings():
        yield


@pytest.mark.parametrize("component", COMPONENTS.values(), ids=COMPONENTS)
def test_no_call_that_fails_or_is_the_last_leaves_harm(component, tmp_path: Path):
    tries, problems = plan([component], tmp_path)
    for _, injection in sample(tries, round(SAMPLE * component.share / SHARES)):
        result = component.measure(tmp_path, injection)
        problems += [f"{injection}, {injection.call.line[:100]}: {problem}" for problem in result.problems]
        if injection.call.name not in ("select", "pselect6", "clock_nanosleep"):  # how often it waits depends on time
            problems += [] if result.reached else [f"{injection}: the work did not come to this call again"]
    assert problems == []


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.plant.__name__)
def test_a_planted_mistake_is_found(mutant: Mutant, tmp_path: Path):
    assert mutant.found_after(tmp_path)

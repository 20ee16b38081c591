"""A component that is killed, or gets an error, at a system call leaves nothing that the next process cannot repair.

This is a sample of the tries of `make soak NAME=syscalls`; planted mistakes show that a try can fail.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.syscalls.component import Component
from tests.syscalls.components import COMPONENTS, surroundings
from tests.syscalls.kinds import REPEATED
from tests.syscalls.mutants import MUTANTS, Mutant
from tests.syscalls.sampling import SEED, plan, sample
from tests.syscalls.serving import end_board
from tests.syscalls.traced import unavailable

SAMPLE = 60
MISSED = 10
"""One try in MISSED may miss its call: the order of threads depends on time."""
SAMPLED = [component for component in COMPONENTS.values() if component.share]
QUICK_MUTANTS = [mutant for mutant in MUTANTS if not mutant.component.startswith("service")]
SHARES = sum(component.share for component in SAMPLED)
pytestmark = [pytest.mark.system, pytest.mark.skipif(bool(unavailable()), reason=unavailable())]


@pytest.fixture(scope="module", autouse=True)
def _board() -> Iterator[None]:
    """End the board of the tries after the last test."""
    yield
    end_board()


@pytest.fixture(autouse=True)
def _surroundings() -> Iterator[None]:
    """Give each test small chunks, the card in a file, and its own environment variables."""
    with surroundings():
        yield


@pytest.mark.parametrize("component", SAMPLED, ids=lambda component: component.name)
def test_no_call_that_fails_or_is_the_last_leaves_harm(component: Component, tmp_path: Path):
    tries, problems = plan([component], tmp_path)
    chosen, missed = sample(tries, round(SAMPLE * component.share / SHARES)), []
    print(f"seed {SEED}, {len(chosen)} of {len(tries)} tries:", *(f"{injection}" for _, injection in chosen), sep="\n")
    for _, injection in chosen:
        result = component.measure(tmp_path, injection)
        problems += [f"{injection}, {injection.call.line[:100]}: {problem}" for problem in result.problems]
        if not result.reached and injection.call.name not in REPEATED:
            missed.append(injection)
    assert problems == []
    assert len(missed) <= 1 + len(chosen) // MISSED, missed


@pytest.mark.parametrize("mutant", QUICK_MUTANTS, ids=lambda mutant: mutant.plant.__name__)
def test_a_planted_mistake_is_found(mutant: Mutant, tmp_path: Path):
    assert mutant.count_tries(tmp_path)

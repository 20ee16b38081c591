"""A sample of what `make soak NAME=syscalls` tries: killed and failing at a system call, judged by the next hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.syscalls.component import Component
from tests.syscalls.components import COMPONENTS, surroundings
from tests.syscalls.kinds import REPEATED
from tests.syscalls.mutants import MUTANTS, Mutant
from tests.syscalls.sampling import SEED, plan, sample
from tests.syscalls.traced import unavailable

SAMPLE = 60
MISSED = 10
"""One try in so many may miss its call: in which order threads run depends on time."""
SAMPLED = [component for component in COMPONENTS.values() if component.share]
QUICK_MUTANTS = [mutant for mutant in MUTANTS if not mutant.component.startswith("service")]
SHARES = sum(component.share for component in SAMPLED)
pytestmark = pytest.mark.skipif(bool(unavailable()), reason=unavailable())


@pytest.fixture(autouse=True)
def _surroundings() -> Iterator[None]:
    with surroundings():
        yield


@pytest.mark.parametrize("component", SAMPLED, ids=lambda component: component.name)
def test_no_call_that_fails_or_is_the_last_leaves_harm(component: Component, tmp_path: Path):
    tries, problems = plan([component], tmp_path)
    chosen, missed = sample(tries, round(SAMPLE * component.share / SHARES)), []
    print(f"seed {SEED}, {len(chosen)} of {len(tries)} tries:", *(f"{one}" for _, one in chosen), sep="\n")
    for _, injection in chosen:
        result = component.measure(tmp_path, injection)
        problems += [f"{injection}, {injection.call.line[:100]}: {problem}" for problem in result.problems]
        if not result.reached and injection.call.name not in REPEATED:
            missed.append(injection)
    assert problems == []
    assert len(missed) <= 1 + len(chosen) // MISSED, missed


@pytest.mark.parametrize("mutant", QUICK_MUTANTS, ids=lambda mutant: mutant.plant.__name__)
def test_a_planted_mistake_is_found(mutant: Mutant, tmp_path: Path):
    assert mutant.found_after(tmp_path)

"""Worlds of fixed seeds: all invariants hold, and a seed has the same bytes in each run."""

from __future__ import annotations

import pytest

from tests.worlds.play import play
from tests.worlds.schedule import Action
from tests.worlds.shrink import remove, report

SEEDS = range(1, 11)
FOUND: tuple[int, ...] = ()
"""Seeds that have found a fault of the product."""


@pytest.mark.parametrize("seed", [*SEEDS, *FOUND])
def test_the_invariants_hold_in_a_world(seed: int):
    outcome = play(seed)
    if outcome.failure is not None:
        pytest.fail(report(seed, outcome.failure), pytrace=False)


def test_a_seed_has_the_same_records_events_and_answers_in_each_run():
    first, second, other = play(12), play(12), play(14)
    assert first.digest == second.digest != other.digest
    assert first.ticks > 1000


def test_a_schedule_shrinks_to_the_actions_that_fail():
    actions = [Action(float(k), "ann/1", "status") for k in range(20)]
    assert remove(actions, lambda rest: actions[3] in rest and actions[17] in rest) == (actions[3], actions[17])

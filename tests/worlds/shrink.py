"""Smaller schedule of a world that fails: the actions without which it still fails in the same way."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from tests.worlds.play import play
from tests.worlds.schedule import Action, draw_world

MOST_PLAYS = 80


def kind_of(failure: str | None) -> str:
    """Return the words of a failure without its numbers."""
    return re.sub(r"[^a-z ]+", "", failure or "")[:40]


def shrink(seed: int, failure: str) -> tuple[Action, ...]:
    """Return the actions of a failing world that are left when as many as possible are removed."""
    kind = kind_of(failure)
    return remove(draw_world(seed).actions, lambda actions: kind_of(play(seed, actions).failure) == kind)


def remove(
    actions: Sequence[Action], fails: Callable[[Sequence[Action]], bool], plays: int = MOST_PLAYS
) -> tuple[Action, ...]:
    """Remove runs of actions, half of them first and single ones last, while `fails` holds for the rest."""
    actions, size = tuple(actions), max(1, len(actions) // 2)
    while plays > 0:
        begin = 0
        while begin < len(actions) and plays > 0:
            rest = actions[:begin] + actions[begin + size :]
            plays -= 1
            if fails(rest):
                actions = rest
            else:
                begin += size
        if size == 1:
            break
        size = max(1, size // 2)
    return actions


def report(seed: int, failure: str) -> str:
    """Return the text of a failure: the seed, the configuration and the shrunk schedule."""
    actions = shrink(seed, failure)
    lines = [f"seed {seed}: {failure}", f"replay it: python -m tests.worlds {seed}", *map(str, actions)]
    return "\n".join([*lines, draw_world(seed).text])

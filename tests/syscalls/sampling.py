"""What is tried: everything at every call, or a seeded sample that every component and kind is in."""

from __future__ import annotations

import random
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.syscalls.component import Component
from tests.syscalls.kinds import injections, thinned
from tests.syscalls.traced import Injection

SEED = 38
Try = tuple[Component, Injection]


def plan(components: Sequence[Component], folder: Path) -> tuple[list[Try], list[str]]:
    """All tries, by a trace of each component's work as it is, and what was wrong without an injection."""
    tries: list[Try] = []
    problems: list[str] = []
    for component in components:
        component.warm_up(folder)
        result = component.measure(folder)
        problems += [f"{component.name}, nothing injected: {problem}" for problem in result.problems]
        calls = thinned(result.calls) if component.is_thinned else result.calls
        calls = calls[:: max(len(calls) // component.most, 1)] if component.most else calls
        print(f"{component.name}: {len(calls)} of {len(result.calls)} calls are tried", file=sys.stderr)
        tries += [(component, injection) for injection in injections(calls)]
    return tries, problems


def sample(tries: Sequence[Try], count: int, seed: int = SEED) -> list[Try]:
    """About `count` of the tries, spread over components by `share`, and over kinds and names of calls."""
    chance, chosen = random.Random(seed), []
    components = list(dict.fromkeys(component for component, _ in tries))
    total = max(sum(component.share for component in components), 1)
    for component in components:
        groups: dict[tuple[str, str], list[Try]] = {}
        for one in tries:
            if one[0] is component:
                groups.setdefault((one[1].kind, one[1].call.name), []).append(one)
        wanted = max(round(count * component.share / total), 1)
        for group in groups.values():
            chance.shuffle(group)
        order = list(groups.values())
        chance.shuffle(order)
        picked: list[Try] = []
        while len(picked) < wanted and any(order):
            picked += [group.pop() for group in order if group]
        chosen += picked[:wanted]
    return chosen

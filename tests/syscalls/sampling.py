"""Choice of the tries: every injection at every call, or a seeded sample of all components and kinds."""

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
    """Trace each component's work without injection; return all tries at its calls, and the problems of that work."""
    tries: list[Try] = []
    problems: list[str] = []
    for component in components:
        component.warm_up(folder)
        result = component.measure(folder)
        problems += [f"{component.name}, nothing injected: {problem}" for problem in result.problems]
        calls = thinned(result.calls) if component.is_thinned else result.calls
        calls = calls[:: max(len(calls) // component.max_calls, 1)] if component.max_calls else calls
        print(f"{component.name}: {len(calls)} of {len(result.calls)} calls are tried", file=sys.stderr)
        tries += [(component, injection) for injection in injections(calls)]
    return tries, problems


def sample(tries: Sequence[Try], count: int, seed: int = SEED) -> list[Try]:
    """Return about `count` tries, spread over components by `share`, and over kinds and names of calls."""
    chance, selection = random.Random(seed), []
    components = list(dict.fromkeys(component for component, _ in tries))
    total = max(sum(component.share for component in components), 1)
    for component in components:
        groups: dict[tuple[str, str], list[Try]] = {}
        for trial in tries:
            if trial[0] is component:
                groups.setdefault((trial[1].kind, trial[1].call.name), []).append(trial)
        size = max(round(count * component.share / total), 1)
        for group in groups.values():
            chance.shuffle(group)
        order = list(groups.values())
        chance.shuffle(order)
        picks: list[Try] = []
        while len(picks) < size and any(order):
            picks += [group.pop() for group in order if group]
        selection += picks[:size]
    return selection

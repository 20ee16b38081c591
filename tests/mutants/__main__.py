"""Mistakes planted at random, and whether the tests see them: `make mutants`. Exit code 0 if 90 % of them die."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console

from tests.mutants.account import Result, Verdict, equivalents, keep, kept, table
from tests.mutants.choice import Choice
from tests.mutants.draw import stored_draw
from tests.mutants.mutant import Change, Mutant
from tests.mutants.places import mutated
from tests.mutants.rooms import ROOMS, ROOT
from tests.mutants.trees import Tree, ended, preload
from tests.mutants.trial import Trial

ENOUGH = 0.9
POLL_S = 0.05
WARM_LIMIT_S = 600.0


def main() -> int:
    """Draw, try what has no result yet, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--mutants", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rooms", nargs="*", choices=ROOMS, default=list(ROOMS))
    parser.add_argument("-j", "--jobs", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="try those that survived again, with the tests of today")
    parser.add_argument("--results", type=Path, default=ROOT / "build" / "mutants" / "results.jsonl")
    options = parser.parse_args()
    folder = options.results.parent
    mutants = [mutant for mutant in stored_draw(folder, options.mutants, options.seed) if mutant.room in options.rooms]
    results = kept(options.results)
    waiting = [
        mutant
        for mutant in mutants
        if (result := results.get(mutant.key)) is None
        or (options.again and result.verdict in (Verdict.SURVIVED, Verdict.UNTESTED))
    ]
    print(f"{len(mutants)} mutants, {len(waiting)} to be tried", file=sys.stderr)
    if waiting:
        with tempfile.TemporaryDirectory(prefix="m", ignore_cleanup_errors=True) as place:
            trees = [Tree(Path(place).resolve() / str(number)) for number in range(options.jobs)]
            preload()
            _warm(trees)
            choice = Choice(folder / "survey")
            choice.survey({mutant.room for mutant in waiting}, trees)
            _try(waiting, choice, trees, options.results)
        results = kept(options.results)
    shown, survivors, score = table(mutants, results, equivalents())
    Console(width=120).print(shown)
    for mutant in survivors:
        print(f"{mutant.place} {results[mutant.key].verdict} {mutant.operator}\n- {mutant.before}\n+ {mutant.after}")
    if untried := sum(mutant.key not in results for mutant in mutants):
        print(f"{untried} could not be tried")
    return int(score < ENOUGH or untried > 0)


def _warm(trees: list[Tree]) -> None:
    """Compile the kernels of all trees, so that no test is surveyed while it compiles. Raises RuntimeError."""
    processes = [(tree, tree.start_warming()) for tree in trees]
    limit_s = time.monotonic() + WARM_LIMIT_S
    for tree, process in processes:
        while (code := ended(process, limit_s)) is None:
            time.sleep(POLL_S)
        if code:
            raise RuntimeError(f"compilation of the kernels: exit code is {code}; allowed: 0\n{tree.output()[-2000:]}")


def _try(waiting: list[Mutant], choice: Choice, trees: list[Tree], path: Path) -> None:
    """Try a mutant in each tree until all have their results.

    One that survives is tried again with compiled kernels, by tests that start processes or take too long uncompiled.
    """
    left, idle, running = list(reversed(waiting)), list(trees), dict[int, tuple[Tree, Trial]]()
    while left or running:
        while left and idle:
            tree, mutant = idle.pop(), left.pop()
            compiled = ROOMS[mutant.room].compiled
            running[id(tree)] = tree, _started(tree, mutant, choice.tests(mutant), compiled=compiled)
        for number, (tree, trial) in list(running.items()):
            try:
                result = trial.result()
            except RuntimeError as error:  # it stays without a result, and is tried again by the next call
                print(f"{trial.mutant.place}: {error}", file=sys.stderr, flush=True)
                idle.append(running.pop(number)[0])
                continue
            if result is None:
                continue
            survived = result.verdict in (Verdict.SURVIVED, Verdict.UNTESTED)
            if survived and not trial.second and (tests := choice.second_look(trial.mutant)):
                running[number] = tree, _started(tree, trial.mutant, tests, compiled=True, second=True)
                continue
            keep(path, trial.mutant, result)
            _say(trial.mutant, result, len(left))
            idle.append(running.pop(number)[0])
        time.sleep(POLL_S)


def _started(tree: Tree, mutant: Mutant, tests: dict[str, float], *, compiled: bool, second: bool = False) -> Trial:
    text = mutated((ROOT / mutant.file).read_text(encoding="utf-8"), Change(mutant.operator, mutant.occurrence))
    assert text is not None  # it was drawn
    return Trial(tree, mutant, text, tests, compiled=compiled, second=second)


def _say(mutant: Mutant, result: Result, left: int) -> None:
    told = f"{left} left, {result.seconds:.0f} s: {mutant.place} {mutant.after[:60]}: {result.verdict} {result.test}"
    print(told, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

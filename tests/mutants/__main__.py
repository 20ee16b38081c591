"""Plant random mistakes (mutants) and report which of them the tests detect: `make mutants`.

Exit code 0 if each could be tried and at least 90 % died, apart from those that change no behaviour.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console

from tests.mutants.account import Result, Verdict, append_result, read_equivalents, read_results, summarise_results
from tests.mutants.choice import Selection
from tests.mutants.draw import load_or_draw
from tests.mutants.mutant import Change, Mutant
from tests.mutants.places import apply_change
from tests.mutants.rooms import ROOMS, ROOT
from tests.mutants.trees import Tree, poll_process, preload
from tests.mutants.trial import Trial

REQUIRED_SCORE = 0.9
POLL_S = 0.05
WARM_LIMIT_S = 600.0


def main() -> int:
    """Draw the mutants, try those without a result, print the table and the survivors; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--mutants", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rooms", nargs="*", choices=ROOMS, default=list(ROOMS))
    parser.add_argument("-j", "--jobs", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="try the survivors again, with the current tests")
    parser.add_argument("--results", type=Path, default=ROOT / "build" / "mutants" / "results.jsonl")
    options = parser.parse_args()
    folder = options.results.parent
    mutants = [mutant for mutant in load_or_draw(folder, options.mutants, options.seed) if mutant.room in options.rooms]
    results = read_results(options.results)
    pending = [
        mutant
        for mutant in mutants
        if (result := results.get(mutant.key)) is None
        or (options.again and result.verdict in (Verdict.SURVIVED, Verdict.UNTESTED))
    ]
    print(f"{len(mutants)} mutants, {len(pending)} to be tried", file=sys.stderr)
    if pending:
        with tempfile.TemporaryDirectory(prefix="m", ignore_cleanup_errors=True) as scratch:
            trees = [Tree(Path(scratch).resolve() / str(number)) for number in range(options.jobs)]
            preload()
            _warm(trees)
            selection = Selection(folder / "survey")
            selection.survey({mutant.room for mutant in pending}, trees)
            _try(pending, selection, trees, options.results)
        results = read_results(options.results)
    table, survivors, score = summarise_results(mutants, results, read_equivalents())
    Console(width=120).print(table)
    for mutant in survivors:
        print(f"{mutant.place} {results[mutant.key].verdict} {mutant.operator}\n- {mutant.before}\n+ {mutant.after}")
    if untried := sum(mutant.key not in results for mutant in mutants):
        print(f"{untried} could not be tried")
    return int(score < REQUIRED_SCORE or untried > 0)


def _warm(trees: list[Tree]) -> None:
    """Compile the kernels of all trees, so that no test compiles during the survey. Raises RuntimeError."""
    processes = [(tree, tree.start_warming()) for tree in trees]
    limit_s = time.monotonic() + WARM_LIMIT_S
    for tree, process in processes:
        while (code := poll_process(process, limit_s)) is None:
            time.sleep(POLL_S)
        if code:
            raise RuntimeError(f"compilation of the kernels: exit code is {code}; allowed: 0\n{tree.output()[-2000:]}")


def _try(pending: list[Mutant], selection: Selection, trees: list[Tree], path: Path) -> None:
    """Try one mutant at a time in each tree and append each result to the file `path`, until no mutant is pending.

    A mutant that survives is tried again with compiled kernels, by the tests that start processes or take too long
    with uncompiled kernels.
    """
    queue, idle, running = list(reversed(pending)), list(trees), dict[int, tuple[Tree, Trial]]()
    while queue or running:
        while queue and idle:
            tree, mutant = idle.pop(), queue.pop()
            compiled = ROOMS[mutant.room].compiled
            running[id(tree)] = tree, _start_trial(tree, mutant, selection.tests(mutant), compiled=compiled)
        for number, (tree, trial) in list(running.items()):
            try:
                result = trial.result()
            except RuntimeError as error:  # Without a result, the next call tries it again.
                print(f"{trial.mutant.place}: {error}", file=sys.stderr, flush=True)
                idle.append(running.pop(number)[0])
                continue
            if result is None:
                continue
            survived = result.verdict in (Verdict.SURVIVED, Verdict.UNTESTED)
            if survived and not trial.second and (tests := selection.second_round(trial.mutant)):
                running[number] = tree, _start_trial(tree, trial.mutant, tests, compiled=True, second=True)
                continue
            append_result(path, trial.mutant, result)
            _print_result(trial.mutant, result, len(queue))
            idle.append(running.pop(number)[0])
        time.sleep(POLL_S)


def _start_trial(tree: Tree, mutant: Mutant, tests: dict[str, float], *, compiled: bool, second: bool = False) -> Trial:
    """Plant a mutant in a tree and start its tests (test: expected seconds); return the running trial."""
    text = apply_change((ROOT / mutant.file).read_text(encoding="utf-8"), Change(mutant.operator, mutant.occurrence))
    assert text is not None  # A mutant is drawn only if its change gives valid Python.
    return Trial(tree, mutant, text, tests, compiled=compiled, second=second)


def _print_result(mutant: Mutant, result: Result, pending_count: int) -> None:
    """Print a mutant's result and the number of mutants still to be tried."""
    outcome = f"{mutant.place} {mutant.after[:60]}: {result.verdict} {result.test}"
    print(f"{pending_count} left, {result.seconds:.0f} s: {outcome}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

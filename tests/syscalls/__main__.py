"""Let every system call of each component fail, or be the last before SIGKILL: `make soak NAME=syscalls`.

    python -m tests.syscalls [COMPONENT ...] [--sample N] [--seed S] [--mutants]

Prints a table: calls tried by component and kind, and failures. Exit code 0 without failures.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.table import Table

from tests.syscalls.components import COMPONENTS, surroundings
from tests.syscalls.kinds import KINDS
from tests.syscalls.sampling import SEED, plan, sample
from tests.syscalls.traced import unavailable

LONGEST = 1_500
"""Longest printed text of a problem, in characters."""


def table(tried: Counter[tuple[str, str]], failed: Counter[str], missed: Counter[str], crashed: Counter[str]) -> Table:
    """Return the table of tries by component and kind.

    `missed` counts tries whose call was not reached: number of waits and order of threads depend on time.
    """
    columns = ("component", *KINDS, "not reached", "traceback", "failed")
    result = Table(*columns, title=f"{sum(tried.values())} calls, failed {sum(failed.values())}")
    for name in dict.fromkeys(component for component, _ in tried):
        counts = [str(tried[name, kind]) for kind in KINDS]
        result.add_row(name, *counts, str(missed[name]), str(crashed[name]), str(failed[name]))
    return result


def main() -> int:
    """Try all calls of the components, or a sample of them, and print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("components", nargs="*", choices=[[], *COMPONENTS], metavar="COMPONENT")
    parser.add_argument("--sample", type=int, metavar="N")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--last-first", action="store_true", help="reverse the order: two such runs meet")
    parser.add_argument("--mutants", action="store_true", help="plant mistakes, each of which a try must find")
    options = parser.parse_args()
    if reason := unavailable():
        print(reason, file=sys.stderr)
        return 1
    if options.mutants:
        from tests.syscalls.mutants import run

        return run()
    tried, start_s = Counter[tuple[str, str]](), time.monotonic()
    failed, missed, crashed = Counter[str](), Counter[str](), Counter[str]()
    with TemporaryDirectory(prefix="rtloop-syscalls-") as folder, surroundings():
        tries, problems = plan([COMPONENTS[name] for name in options.components or COMPONENTS], Path(folder))
        print(*problems, sep="\n", file=sys.stderr)
        failed.update(["nothing injected"] * len(problems))
        selection = tries if options.sample is None else sample(tries, options.sample, options.seed)
        selection = selection[::-1] if options.last_first else selection
        for number, (component, injection) in enumerate(selection, start=1):
            result = component.measure(Path(folder), injection)
            tried[component.name, injection.kind] += result.reached
            missed[component.name] += not result.reached
            if result.crashed:
                crashed[component.name] += 1
                print(f"{component.name}: {injection}: ends in a traceback", file=sys.stderr)
            if result.problems:
                failed[component.name] += 1
                print(f"{component.name}: {injection}: {injection.call.line[:200]}", file=sys.stderr)
                print("   " + "\n   ".join(problem[-LONGEST:] for problem in result.problems), file=sys.stderr)
            if number % 100 == 0:
                print(f"{number}/{len(selection)}, {time.monotonic() - start_s:.0f} s", file=sys.stderr, flush=True)
    Console(width=140).print(table(tried, failed, missed, crashed))
    return int(any(failed.values()))


if __name__ == "__main__":
    sys.exit(main())

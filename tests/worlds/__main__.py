"""Play worlds: `python -m tests.worlds SEED` one, `make soak NAME=worlds` many; a failing schedule is shrunk."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter

from tests.worlds.play import play
from tests.worlds.shrink import report


def main() -> int:
    """Play the worlds of the given seeds, or for some minutes; return 1 if one fails."""
    parser = argparse.ArgumentParser(prog="worlds", description=__doc__)
    parser.add_argument("seeds", nargs="*", type=int)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--first", type=int, default=1000, help="first seed of the worlds that are played for a time")
    options = parser.parse_args()
    end_s, seed, failing = time.monotonic() + 60.0 * options.minutes, options.first, []
    faults, virtual_s, ticks, answers, count = Counter[str](), 0.0, 0, 0, 0
    seeds = iter(options.seeds)
    while (seed := next(seeds, -1) if options.seeds else seed + 1) >= 0 and time.monotonic() < end_s:
        outcome = play(seed)
        faults += outcome.faults
        virtual_s, ticks, answers = virtual_s + outcome.virtual_s, ticks + outcome.ticks, answers + outcome.answers
        count += 1
        if outcome.failure is not None:
            failing.append(seed)
            print(report(seed, outcome.failure), flush=True)
    print(f"{count} worlds, {virtual_s / 3600:.2f} virtual hours, {ticks:,} ticks and {answers:,} answers checked")
    print("faults: " + ", ".join(f"{number} {kind}" for kind, number in sorted(faults.items())))
    print(f"failing seeds: {', '.join(map(str, failing)) or 'none'}")
    return int(bool(failing))


if __name__ == "__main__":
    sys.exit(main())

"""What the paper's controller and rtloop's own come to on one rig, beside the goals. `make soak NAME=flagship`.

Runs are of the loop itself in virtual time: in this process, as bytes of recorded ones, or recorded (`scan`). Steps are
judged by the true position, between ticks too. Ends with 1 where a goal is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.soak.flagship import looped, rigs, scanned, stepped
from tests.soak.flagship.pictures import draw
from tests.soak.flagship.stage import LEVELS_UM, loop
from tests.soak.flagship.table import text


def main() -> int:
    """A table, and a folder with it as JSON and pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=500, help="rigs drawn at random; 0 for none")
    parser.add_argument("--seed", type=int, default=1, help="of the rigs that are drawn")
    parser.add_argument("--rigs", action="store_true", help="other stages too: some ten minutes more")
    parser.add_argument("--out", type=Path, default=Path("recordings/flagship"))
    given = parser.parse_args()
    began_s = time.monotonic()

    def say(line: str) -> None:
        print(f"[{time.monotonic() - began_s:5.0f} s] {line}", file=sys.stderr, flush=True)

    paper, ours = loop("paper"), loop("robust")
    curves = dict[str, Any]()
    found = stepped.as_configured(paper, ours)
    rows, shifts = stepped.over_shift(paper, ours, say)
    found += rows
    curves["steps"], curves["shift"] = shifts.traces, shifts.steps
    rows, curves["loops"] = looped.linear_rows(paper, ours)
    found += [*rows, *looped.rig_rows(paper, ours)]
    say("loops: done")
    with tempfile.TemporaryDirectory() as name:
        rows, scans = scanned.rows(Path(name))
    found += rows
    curves["scans"] = {**scans, "goals": scanned.GOALS}
    say("scans: done")
    if given.draws:
        loops = {"paper": paper, "ours": ours, "wide": shifts.wide}
        rows, curves["draws"] = stepped.drawn(loops, given.draws, given.seed, say)
        found += rows
    if given.rigs:
        found += rigs.rows(say)
    given.out.mkdir(parents=True, exist_ok=True)
    said = {"levels_um": LEVELS_UM, "noise_seeds": stepped.SEEDS, "draws": given.draws, "draws_seed": given.seed,
            "seconds": round(time.monotonic() - began_s), "rows": [row.as_dict() for row in found]}  # fmt: skip
    (given.out / "flagship.json").write_text(json.dumps(said, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    draw(given.out, curves)
    print(text(found))
    print(f"noise seeds {stepped.SEEDS}, rigs drawn by seed {given.seed}; {given.out}/")
    return int(any(row.met is False for row in found))


if __name__ == "__main__":
    sys.exit(main())

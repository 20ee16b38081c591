"""The paper's controller and rtloop's own on one rig, compared with goals. `make soak NAME=flagship`.

All runs execute the loop itself in virtual time: in this process, bit by bit as recorded runs, or recorded (`scan`).
Steps are judged by the true position, between ticks too. The exit code is 1 where a goal is missed.
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
from tests.soak.flagship.stage import LEVELS_UM, load_loop
from tests.soak.flagship.table import format_table


def main() -> int:
    """Print the table and write it as JSON, with pictures, to a folder; return 1 if a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=500, help="rigs drawn at random; 0 for none")
    parser.add_argument("--seed", type=int, default=1, help="seed of the drawn rigs")
    parser.add_argument("--rigs", action="store_true", help="other stages too: some ten minutes more")
    parser.add_argument("--out", type=Path, default=Path("recordings/flagship"))
    options = parser.parse_args()
    began_s = time.monotonic()

    def show_progress(line: str) -> None:
        print(f"[{time.monotonic() - began_s:5.0f} s] {line}", file=sys.stderr, flush=True)

    paper, ours = load_loop("paper"), load_loop("robust")
    curves = dict[str, Any]()
    table_rows = stepped.configured_rows(paper, ours)
    rows, shifts = stepped.shift_rows(paper, ours, show_progress)
    table_rows += rows
    curves["steps"], curves["shift"] = shifts.traces, shifts.steps
    rows, curves["loops"] = looped.linear_rows(paper, ours)
    table_rows += [*rows, *looped.rig_rows(paper, ours)]
    show_progress("loops: done")
    with tempfile.TemporaryDirectory() as name:
        rows, scans = scanned.scan_rows(Path(name))
    table_rows += rows
    curves["scans"] = {**scans, "goals": scanned.GOALS}
    show_progress("scans: done")
    if options.draws:
        loops = {"paper": paper, "ours": ours, "wide": shifts.wide}
        rows, curves["draws"] = stepped.drawn_rows(loops, options.draws, options.seed, show_progress)
        table_rows += rows
    if options.rigs:
        table_rows += rigs.stage_rows(show_progress)
    options.out.mkdir(parents=True, exist_ok=True)
    report = {"levels_um": LEVELS_UM, "noise_seeds": stepped.SEEDS, "draws": options.draws, "draws_seed": options.seed,
              "seconds": round(time.monotonic() - began_s), "rows": [row.as_dict() for row in table_rows]}  # fmt: skip
    (options.out / "flagship.json").write_text(json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    draw(options.out, curves)
    print(format_table(table_rows))
    print(f"noise seeds {stepped.SEEDS}, rigs drawn by seed {options.seed}; {options.out}/")
    return int(any(row.is_met is False for row in table_rows))


if __name__ == "__main__":
    sys.exit(main())

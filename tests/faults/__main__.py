"""Inject every fault into real processes and print a table of the verdicts: `make faults`. Exit code 0 if all hold."""

from __future__ import annotations

import argparse
import json
import sys

from rich.console import Console
from rich.table import Table

from tests.faults import clock, hardware, laws, outputs, processes, recovery, requests, storage
from tests.faults.fault import Row, measure

FAULTS = (
    *(*processes.FAULTS, *hardware.FAULTS, *storage.FAULTS),
    *(*requests.FAULTS, *clock.FAULTS, *outputs.FAULTS, *laws.FAULTS, *recovery.FAULTS),
)
COLUMNS = ("fault", "what must happen", "safe after (host stalled)", "lost / executed",
           "largest |drive|; step, change in 1 ms (allowed)", "verdict")  # fmt: skip

LONGEST = 120
"""Longest text of a problem in the table, in characters; stderr shows the whole text."""


def cells(row: Row) -> tuple[str, ...]:
    """Return the texts of a row, one for each of COLUMNS."""
    outcome, ticks = row.outcome, row.account
    safe = "—" if outcome.safe_ms is None else (
        f"{outcome.safe_ms:.1f} ms, {outcome.safe_ms * row.bounds.rate_hz / 1000:.0f} ticks ({row.stalled_ms:.1f} ms)"
    )  # fmt: skip
    step, window = f"{row.step_v:.3f} V ({row.bounds.step_v:.3f})", f"{row.window_v:.3f} V ({row.bounds.window_v:.3f})"
    drive = f"{row.largest_v:.2f} V; {step}, {window}"
    verdict = f"not possible here: {row.skipped}" if row.skipped else ("holds" if not row.problems else "FAILS")
    notes = filter(None, (outcome.note,))
    return (row.fault.name, row.fault.must, safe, f"{ticks.lost} / {ticks.executed}", drive,
            "; ".join([verdict, *notes, *(problem[:LONGEST] for problem in row.problems)]))  # fmt: skip


def main() -> int:
    """Measure all faults, or those whose name contains one of the words on the command line; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--json", action="store_true", help="print names and problems alone")
    arguments = parser.parse_args()
    words = arguments.words
    faults = [fault for fault in FAULTS if not words or any(word in fault.name for word in words)]
    rows = []
    for number, fault in enumerate(faults, start=1):
        print(f"{number}/{len(faults)} {fault.name}", file=sys.stderr, flush=True)
        rows.append(measure(fault))
        if rows[-1].problems:
            print("   " + "\n   ".join(rows[-1].problems), file=sys.stderr, flush=True)
    if arguments.json:
        print(json.dumps([{"fault": row.fault.name, "problems": row.problems} for row in rows]))
        return int(any(row.problems for row in rows))
    table = Table(*COLUMNS, title=f"{len(rows)} faults")
    for row in rows:
        table.add_row(*cells(row))
    Console(width=200).print(table)
    return int(any(row.problems for row in rows))


if __name__ == "__main__":
    sys.exit(main())

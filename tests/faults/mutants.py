"""Proof that the fault table can fail: one planted mistake at a time, with the rows that it concerns.

Every mistake must make at least one of its rows fail, with a problem that names the mistake's effect. Without a mistake
no row may fail. Exit code 0 if both hold. The mistakes are planted while the modules are loaded (`planting/`): no file
of the tree changes, and nothing is compiled again.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

PLANTING = Path(__file__).with_name("planting")
PARKED, STUCK = "loop SIGKILL, no restart", "loop SIGSTOP"
STOPPED, CARD = "SIGTERM under drive", "driver blocks for good"
DEATHS = "parking SIGKILL, again and again"
"""Two hundred parkings. A single one may hide a mistake: its last step below 0.2 V may be no larger than the others,
and on a busy processor it may be as slow as a ramp although it does not wait."""
STEEP, LATE = r"a step of|within 1 ms", r"safe after"
RAMP, SUPERVISOR = "rtloop.engine.ramp", "rtloop.supervision.supervisor"


class Mutant(NamedTuple):
    """A mistake: the text `old` of `module` replaced by `new`. `effect` is a pattern of the problems that it causes."""

    name: str
    module: str
    old: str
    new: str
    effect: str
    rows: tuple[str, ...]


MUTANTS = (
    Mutant("a ramp that does not wait between its steps", RAMP,
           "def _wait_until(until_s: float) -> None:\n", "def _wait_until(until_s: float) -> None:\n    return\n",
           STEEP, (PARKED, CARD, DEATHS)),
    Mutant("a ramp 2.1 times as steep", RAMP,
           "slew_v_per_s * period_s)", "2.1 * slew_v_per_s * period_s)", STEEP, (PARKED, CARD)),
    Mutant("a loop's own ramp 2.1 times as steep", "rtloop.configuration.coefficients",
           "options.trip_slew_v_per_s * period_s", "2.1 * options.trip_slew_v_per_s * period_s", STEEP, (STOPPED,)),
    Mutant("a service that notices a dead or stuck loop 850 ms late", SUPERVISOR,
           "        if not ProcessState.has_ended(self.block.load(Word.LOOP_STATE)):\n            death_text",
           "        time.sleep(0.85)\n"
           "        if not ProcessState.has_ended(self.block.load(Word.LOOP_STATE)):\n            death_text",
           LATE, (PARKED, STUCK)),
    Mutant("a parking that steps the last 0.2 V", RAMP,
           "current_v = np.clip(safe_v, current_v - step_v, current_v + step_v)",
           "current_v = np.where(np.abs(safe_v - current_v) <= 0.2, safe_v, "
           "np.clip(safe_v, current_v - step_v, current_v + step_v))",
           STEEP, (PARKED, DEATHS)),
    Mutant("a driver's close that writes 0 V at once in place of the ramp", RAMP,
           "    write = _WRITE(pointers.write)", "    return\n    write = _WRITE(pointers.write)", STEEP,
           (PARKED, CARD)),
)  # fmt: skip


def failures(rows: tuple[str, ...], mutant: Mutant | None) -> dict[str, list[str]]:
    """Return the problems of each row that fails, with a mistake planted or, for None, without one."""
    environment = dict(os.environ)
    if mutant is not None:
        environment |= {"PYTHONPATH": os.pathsep.join([str(PLANTING), environment.get("PYTHONPATH", "")]),
                        "RTLOOP_PLANTED_MODULE": mutant.module, "RTLOOP_PLANTED_OLD": mutant.old,
                        "RTLOOP_PLANTED_NEW": mutant.new}  # fmt: skip
    command = [sys.executable, "-m", "tests.faults", "--json", *rows]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=False)
    measured = json.loads(done.stdout)
    mismatched = sorted(set(rows) ^ {row["fault"] for row in measured})
    assert not mismatched, f"rows {mismatched} were either requested or measured, not both"
    return {row["fault"]: row["problems"] for row in measured if row["problems"]}


def main() -> int:
    """Print the rows that each mistake makes fail; words on the command line select mistakes by their names."""
    words = sys.argv[1:]
    mutants = [mutant for mutant in MUTANTS if not words or any(word in mutant.name for word in words)]
    all_rows = tuple(dict.fromkeys(row for mutant in mutants for row in mutant.rows))
    failed = failures(all_rows, None)
    print(f"without a mistake: {'; '.join(f'{row}: {problems}' for row, problems in failed.items()) or 'all hold'}")
    passed = not failed
    for mutant in mutants:
        noticed = {row: [problem for problem in problems if re.search(mutant.effect, problem)]
                   for row, problems in failures(mutant.rows, mutant).items()}  # fmt: skip
        effects = [f"{row}: {problems[0]}" for row, problems in noticed.items() if problems]
        print(f"{mutant.name} → {'; '.join(effects) or 'NOT NOTICED'}", flush=True)
        passed = passed and bool(effects)
    return int(not passed)


if __name__ == "__main__":
    sys.exit(main())

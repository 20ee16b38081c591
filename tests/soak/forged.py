"""Hundreds of recordings forged for replays by several jobs, then thousands through every command: `… [COUNT] [FIRST]`.

The first ones get the same answer for 1, 2, 3, 4 and 16 jobs, and none that is too good; COUNT 0 leaves the others out.
The others run in worker processes. When a worker dies, the file that it had begun is reported, and another worker
continues with the next file.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path

from tests.recording.forged_cuts import JOBS, check, record_originals
from tests.recording.forged_worker import CODES

ROOT = Path(__file__).resolve().parents[2]
COUNT, BATCH, EVERY = 10_000, 500, 40
"""Files; files of a worker; one in so many also runs the slow commands."""
CUT_COUNT, CUT_EVERY = 500, 25
"""Recordings for replays by several jobs; one in so many is replayed by the command, too."""
MAX_MIB = 600


class Table:
    """Counts of the outcomes by command, and a line for each outcome that is not allowed."""

    def __init__(self) -> None:
        self.counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self.faults: list[str] = []
        self.peak_mib = 0

    def add(self, forgery: str, line: dict[str, object]) -> None:
        """Count the outcomes of one file, from a worker's line of JSON."""
        self.peak_mib = max(self.peak_mib, int(str(line["peak_mib"])))
        outcomes = line["outcomes"]
        assert isinstance(outcomes, dict)
        for command, outcome in outcomes.items():
            is_allowed = outcome.isdigit() and int(outcome) in CODES
            self.counts[command][f"exit {outcome}" if is_allowed else outcome.split()[0]] += 1
            if not is_allowed:
                self.faults.append(f"{line['number']} ({forgery}): {command}: {outcome}")
                print(self.faults[-1], flush=True)

    def show(self) -> None:
        """Print the outcomes of each command, the largest memory and the faults."""
        for command, counts in self.counts.items():
            print(
                f"{command:15} {sum(counts.values()):6}  " + ", ".join(f"{k}: {n}" for k, n in sorted(counts.items()))
            )
        print(f"largest worker: {self.peak_mib} MiB")
        print("\n".join(self.faults) or "no crash, no hang, no traceback, no false verdict of identity")


def run_worker(table: Table, first: int, count: int) -> int:
    """Run one worker for `count` files from number `first`. Return the number of the next file."""
    with tempfile.TemporaryDirectory(dir=_memory_folder()) as folder:
        command = [sys.executable, "-m", "tests.recording.forged_worker", folder, first, count, EVERY]
        worker = subprocess.Popen([str(word) for word in command], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        current: dict[str, object] = {"number": first - 1, "what": "before the first file"}
        last_done = first - 1
        for line_text in worker.stdout or ():
            line = json.loads(line_text)
            if "what" in line:
                current = line
            else:
                table.add(str(current["what"]), line)
                last_done = int(line["number"])
        code = worker.wait()
    if code == 0:
        return first + count
    name = signal.Signals(-code).name if code < 0 else f"exit {code}"
    table.counts["worker"][name] += 1
    table.faults.append(f"{current['number']} ({current['what']}): the worker ended with {name}")
    return max(last_done, int(str(current["number"]))) + 1


def check_jobs(count: int) -> int:
    """Replay `count` recordings, forged where spans are cut, by several jobs. Returns the number of wrong answers."""
    faults, identical, begin_s = [], 0, time.monotonic()
    with tempfile.TemporaryDirectory(dir=_memory_folder()) as name:
        originals = record_originals(Path(name))
        for number in range(count):
            fault, is_identical = check(originals, Path(name), number, number % CUT_EVERY == 0)
            identical += is_identical
            if fault:
                faults.append(fault)
                print(fault, flush=True)
    print(
        f"{count} recordings by {', '.join(map(str, JOBS))} jobs in {time.monotonic() - begin_s:.0f} s: "
        f"{identical} identical, {len(faults)} wrong",
        flush=True,
    )
    return len(faults)


def _memory_folder() -> str | None:
    """Return a folder in memory, None where there is none."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def main() -> int:
    """Print the outcomes; return 1 for a fault, or a worker that needed more than MAX_MIB."""
    count, first = (int(word) for word in (*sys.argv[1:], *(str(COUNT), "0")[len(sys.argv) - 1 :]))
    wrong = check_jobs(CUT_COUNT)
    table, number, begin_s = Table(), first, time.monotonic()
    while number < first + count:
        number = run_worker(table, number, min(BATCH, first + count - number))
        print(
            f"{number - first} of {count} in {time.monotonic() - begin_s:.0f} s, {len(table.faults)} wrong", flush=True
        )
    table.show()
    return 1 if wrong or table.faults or table.peak_mib > MAX_MIB else 0


if __name__ == "__main__":
    sys.exit(main())

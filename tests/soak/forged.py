"""Forged recordings by the thousand through every command, in workers of their own: `… [COUNT] [FIRST]`.

A worker that dies or hangs has died of the file that it had begun: it is named, and another one goes on behind it.
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

from tests.recording.forged_worker import CODES

ROOT = Path(__file__).resolve().parents[2]
COUNT, BATCH, EVERY = 10_000, 500, 40
MOST_MIB = 600


class Table:
    """How often each command ended how, and what must not have been."""

    def __init__(self) -> None:
        self.counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self.wrong: list[str] = []
        self.peak_mib = 0

    def add(self, what: str, line: dict[str, object]) -> None:
        """One file that a worker has got through."""
        self.peak_mib = max(self.peak_mib, int(str(line["peak_mib"])))
        outcomes = line["outcomes"]
        assert isinstance(outcomes, dict)
        for use, outcome in outcomes.items():
            good = outcome.isdigit() and int(outcome) in CODES
            self.counts[use][f"exit {outcome}" if good else outcome.split()[0]] += 1
            if not good:
                self.wrong.append(f"{line['number']} ({what}): {use}: {outcome}")
                print(self.wrong[-1], flush=True)

    def show(self) -> None:
        """Command by command."""
        for use, counts in self.counts.items():
            print(f"{use:15} {sum(counts.values()):6}  " + ", ".join(f"{k}: {n}" for k, n in sorted(counts.items())))
        print(f"largest worker: {self.peak_mib} MiB")
        print("\n".join(self.wrong) or "no crash, no hang, no traceback, nothing wrongly identical")


def work(table: Table, first: int, count: int) -> int:
    """One worker; returns the number of the next file."""
    with tempfile.TemporaryDirectory(dir=_quick_folder()) as folder:
        command = [sys.executable, "-m", "tests.recording.forged_worker", folder, first, count, EVERY]
        worker = subprocess.Popen([str(word) for word in command], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        begun: dict[str, object] = {"number": first - 1, "what": "before the first file"}
        ended = first - 1
        for text in worker.stdout or ():
            line = json.loads(text)
            if "what" in line:
                begun = line
            else:
                table.add(str(begun["what"]), line)
                ended = int(line["number"])
        code = worker.wait()
    if code == 0:
        return first + count
    name = signal.Signals(-code).name if code < 0 else f"exit {code}"
    table.counts["worker"][name] += 1
    table.wrong.append(f"{begun['number']} ({begun['what']}): the worker ended with {name}")
    return max(ended, int(str(begun["number"]))) + 1


def _quick_folder() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def main() -> int:
    """The table; 1 where something was wrong."""
    count, first = (int(word) for word in (*sys.argv[1:], *(str(COUNT), "0")[len(sys.argv) - 1 :]))
    table, number, begun_s = Table(), first, time.monotonic()
    while number < first + count:
        number = work(table, number, min(BATCH, first + count - number))
        print(
            f"{number - first} of {count} in {time.monotonic() - begun_s:.0f} s, {len(table.wrong)} wrong", flush=True
        )
    table.show()
    return 1 if table.wrong or table.peak_mib > MOST_MIB else 0


if __name__ == "__main__":
    sys.exit(main())

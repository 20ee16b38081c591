"""Memory of each process of a paced service."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tests.benchmarks.board import board_configuration
from tests.benchmarks.configurations import SINE, STEPS
from tests.benchmarks.measure import Effort, spread
from tests.faults.bench import Bench

SETTLE_S, APART_S = 8.0, 0.5
"""Wait before the first look, after which the whole ring of records is in memory, and time between two looks."""
ROLES = ("rt", "recorder", "service")


def memory_mib(pid: int) -> dict[str, float]:
    """Return resident, proportional and private memory of a process in MiB, as /proc/PID/smaps_rollup reports them."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    kib = {line.split(":")[0]: int(line.split()[1]) for line in lines}
    private = kib["Private_Clean"] + kib["Private_Dirty"]
    return {"rss_mib": kib["Rss"] / 1024, "pss_mib": kib["Pss"] / 1024, "private_mib": private / 1024}


def memory(effort: Effort) -> dict[str, Any]:
    """MiB of the loop's process, the recorder and the service, once the ring is full: resident (RSS), proportional
    (PSS, a shared page is divided among the processes that share it) and private. `rtloop serve` runs at 10 kHz
    on a board that is a separate process. The loop's process locks its memory, including the shared block of
    records.
    """
    with tempfile.TemporaryDirectory() as name, Bench(Path(name), text=_configuration(Path(name))) as bench:
        time.sleep(SETTLE_S)
        reports: dict[str, list[Mapping[str, float]]] = {role: [] for role in ROLES}
        for _ in _spaced_counts(effort.pairs):
            for role, rows in reports.items():
                rows.append(memory_mib(bench.pid(role)))
        if bench.stop() != 0:
            raise RuntimeError(bench.log())
    return {
        role: {kind: spread([report[kind] for report in rows]) for kind in rows[0]} for role, rows in reports.items()
    }


def _configuration(folder: Path) -> str:
    """Return the configuration of a loop on a board in `folder`, which records there too."""
    recordings = ('folder = "recordings"', f'folder = "{folder}/recordings"')
    return board_configuration(folder / "board", (STEPS, SINE), recordings)


def _spaced_counts(count: int) -> Iterator[int]:
    """Yield 0 … count - 1, each after a pause of APART_S."""
    for number in range(count):
        time.sleep(APART_S)
        yield number

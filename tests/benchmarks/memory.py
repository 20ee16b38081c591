"""Memory of each process of a paced run at rest."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tests.benchmarks.board import on_a_board
from tests.benchmarks.configurations import SINE, STEPS
from tests.benchmarks.measure import Effort, spread
from tests.faults.bench import Bench

SETTLE_S, APART_S = 8.0, 0.5
"""The ring of records, which holds ten seconds, is then in memory as a whole."""
ROLES = ("rt", "recorder", "service")


def memory_mib(pid: int) -> dict[str, float]:
    """RSS counts a page in every process that has it, PSS a share of it; private ones are this process's alone."""
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
        for _ in _apart(effort.pairs):
            for role, found in reports.items():
                found.append(memory_mib(bench.pid(role)))
        if bench.stop() != 0:
            raise RuntimeError(bench.log())
    return {
        role: {kind: spread([report[kind] for report in found]) for kind in found[0]} for role, found in reports.items()
    }


def _configuration(folder: Path) -> str:
    return on_a_board(folder / "board", (STEPS, SINE), ('folder = "recordings"', f'folder = "{folder}/recordings"'))


def _apart(count: int) -> Iterator[int]:
    for number in range(count):
        time.sleep(APART_S)
        yield number

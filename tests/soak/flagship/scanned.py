"""Triangles that are learned, by the experiment `scan`: recorded runs of the loop itself."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

from rtloop.cli.experiment import run_experiments
from tests.soak.flagship.stage import written
from tests.soak.flagship.table import Row

SHIFTS = (-10.0, 0.0, 10.0)
GOALS = {10: 0.06, 50: 0.21, 100: 0.42}
CYCLES = 5


def scanned(name: str, truth_percent: float, folder: Path) -> list[list[float]]:
    """Rms error in % of 40 µm peak to peak: of each frequency, cycle by cycle; what nobody learns for the paper's."""
    is_paper = name == "paper"
    settings = (f"scan.cycles={0 if is_paper else CYCLES}", f"scan.resonance_percent={0 if is_paper else 10}")
    out = folder / f"scan-{name}{truth_percent:+g}"
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        run_experiments(("scan",), written(name, truth_percent, folder), settings, out=out, as_json=True)
    (section,) = json.loads((out / "report.json").read_text())["experiments"]
    if section["problem"]:
        raise RuntimeError(section["problem"])
    (table,) = section["tables"]
    return [[float(cell) for cell in row[1:-1]] for row in table["rows"]]


def rows(folder: Path) -> tuple[list[Row], dict[str, Any]]:
    """The worst of three resonances; the paper's loop on its model, without learning."""
    paper = scanned("paper", 0.0, folder)
    ours = {percent: scanned("robust", percent, folder) for percent in SHIFTS}
    found = [
        Row(f"triangle of 40 µm at {hz} Hz, resonance −10, 0, +10 %, {CYCLES} cycles", "%", goal, paper[number][0],
            max(one[number][-1] for one in ours.values()))
        for number, (hz, goal) in enumerate(GOALS.items())
    ]  # fmt: skip
    return found, {"paper": paper, **{f"{percent:+g}": one for percent, one in ours.items()}}

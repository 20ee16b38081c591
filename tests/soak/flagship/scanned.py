"""Rows of triangles under learning, by the experiment `scan`: recorded runs of the loop itself."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

from rtloop.cli.experiment import run_experiments
from tests.soak.flagship.stage import write_shifted_configuration
from tests.soak.flagship.table import Row

SHIFTS = (-10.0, 0.0, 10.0)
GOALS = {10: 0.06, 50: 0.21, 100: 0.42}
CYCLES = 5


def scan_errors(name: str, truth_percent: float, folder: Path) -> list[list[float]]:
    """Return the rms error (% of 40 µm peak to peak) of each frequency and cycle; the paper's loop does not learn."""
    is_paper = name == "paper"
    settings = (f"scan.cycles={0 if is_paper else CYCLES}", f"scan.resonance_percent={0 if is_paper else 10}")
    out = folder / f"scan-{name}{truth_percent:+g}"
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        run_experiments(
            ("scan",), write_shifted_configuration(name, truth_percent, folder), settings, out=out, as_json=True
        )
    (section,) = json.loads((out / "report.json").read_text())["experiments"]
    if section["problem"]:
        raise RuntimeError(section["problem"])
    (table,) = section["tables"]
    return [[float(cell) for cell in row[1:-1]] for row in table["rows"]]


def scan_rows(folder: Path) -> tuple[list[Row], dict[str, Any]]:
    """Return rows with the worst of three resonances, and all errors; the paper's loop runs on its model only."""
    paper = scan_errors("paper", 0.0, folder)
    ours = {percent: scan_errors("robust", percent, folder) for percent in SHIFTS}
    rows = [
        Row(f"triangle of 40 µm at {hz} Hz, resonance −10, 0, +10 %, {CYCLES} cycles", "%", goal, paper[number][0],
            max(errors[number][-1] for errors in ours.values()))
        for number, (hz, goal) in enumerate(GOALS.items())
    ]  # fmt: skip
    return rows, {"paper": paper, **{f"{percent:+g}": errors for percent, errors in ours.items()}}

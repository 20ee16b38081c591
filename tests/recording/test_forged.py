"""Forged recordings: no command crashes, hangs or prints a traceback, and no replay is wrongly identical."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.recording.forged_worker import CODES

ROOT = Path(__file__).resolve().parents[2]
COUNT, EVERY = 40, 20
MAX_PEAK_MIB = 600


def test_forged_files_are_used_without_a_crash(tmp_path: Path):
    """`make soak NAME=forged` tries 10 000 files."""
    command = [sys.executable, "-m", "tests.recording.forged_worker", tmp_path, "0", str(COUNT), str(EVERY)]
    worker = subprocess.run([str(word) for word in command], cwd=ROOT, capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in worker.stdout.splitlines()]
    assert worker.returncode == 0, (lines[-1], worker.stderr[-1_000:])
    assert len(lines) == 2 * COUNT
    allowed_outcomes = {str(code) for code in CODES}
    faults = [
        (before["what"], command_name, outcome)
        for before, after in zip(lines[::2], lines[1::2], strict=True)
        for command_name, outcome in after["outcomes"].items()
        if outcome not in allowed_outcomes
    ]
    assert not faults
    outcomes = [line["outcomes"]["replay"] for line in lines[1::2]]
    assert {"0", "1", "66"} <= set(outcomes)
    assert lines[-1]["peak_mib"] < MAX_PEAK_MIB

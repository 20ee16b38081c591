"""A recording can be read, exported and plotted on a system without Linux's calls, where no loop can run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import rtloop
from tests.packaging.distribution import ROOT
from tests.recording.real_loop import eventful_configuration, record

pytestmark = pytest.mark.system

TICKS = 300


@pytest.mark.soak
def test_a_recording_is_read_exported_and_plotted_without_the_calls_of_linux(tmp_path: Path):
    pytest.importorskip("matplotlib", reason="matplotlib is missing: the extra 'plot' installs it")
    (recording,) = record(tmp_path / "run.mcap", eventful_configuration(), TICKS)
    program = Path(__file__).with_name("foreign_system.py")
    completed = subprocess.run(
        [sys.executable, str(program), str(recording), str(tmp_path)], capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"},
    )  # fmt: skip
    assert completed.returncode == 0, completed.stderr
    lines = completed.stdout.splitlines()
    assert lines[0] == f"ticks {TICKS}"
    assert {"done info", "done export", "done plot"} <= set(lines)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    head, *rows = (tmp_path / "a.csv").read_text(encoding="ascii").splitlines()
    column = head.split(",").index("x_position_um")
    assert [float(row.split(",")[column]) for row in rows] == rtloop.load(recording)["x_position_um"].tolist()

"""Commands of rtloop in separate processes, and the memory of a board."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from rtloop.hil.board import BoardMemory

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


def rtloop(*arguments: str | Path) -> subprocess.Popen[str]:
    """Start a command of rtloop and return its process."""
    command = [sys.executable, "-m", "rtloop", *map(str, arguments)]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def completed(*command: str | Path, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command to its end and return its result; modules in `folder` can be imported."""
    environment = ENVIRONMENT if folder is None else ENVIRONMENT | {"PYTHONPATH": f"{ROOT}{os.pathsep}{folder}"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=250, check=False)


def board_memory(path: Path) -> BoardMemory:
    """Map the memory of a board and return it."""
    with path.open("r+b") as file:
        return BoardMemory(file.fileno())

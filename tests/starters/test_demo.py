"""`rtloop demo`: real processes; the panel answers, Ctrl-C ends all of them, and no file is left."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import tomllib
import urllib.request
from pathlib import Path

import pytest

from rtloop.configuration.file import parse
from rtloop.starters.demonstration import PREFIX, demonstration_text

pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[2]
MEMORY = Path("/dev/shm")
TIMEOUT_S, ANSWER_S = 240, 100


def find_command_lines(text: str) -> list[str]:
    """Return the command lines of running processes that contain a text."""
    lines = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            lines.append(path.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
    return [line for line in lines if text in line]


def test_the_configuration_is_the_board_that_ships_with_other_paths() -> None:
    raw = tomllib.loads(demonstration_text(Path("/dev/shm/a/board"), Path("/tmp/b/recordings")))
    board = tomllib.loads((ROOT / "deploy/board.toml").read_text())
    assert raw.pop("recording") == {**board.pop("recording"), "folder": "/tmp/b/recordings"}
    assert raw.pop("service") == {**board.pop("service"), "arm": True}
    assert raw["driver"].pop("file") == "/dev/shm/a/board"
    assert board["driver"].pop("file") != "/dev/shm/a/board"
    assert raw == board
    parse(demonstration_text(MEMORY / "a", Path("/tmp/b")), "demo", Path(), "demo.toml")


def test_ctrl_c_ends_all_processes_and_leaves_no_file(tmp_path: Path) -> None:
    runtime, folder = tmp_path / "runtime", tmp_path / ("longer than the path of a socket may be " * 3)
    folder.mkdir()
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(folder), "RUNTIME_DIRECTORY": str(runtime)}
    command = [sys.executable, "-m", "rtloop", "demo", "--port", "0"]
    before = set(MEMORY.glob(f"{PREFIX}*")) if MEMORY.is_dir() else set()
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment, cwd=tmp_path) as demo:
        assert demo.stderr is not None
        watchdog = threading.Timer(TIMEOUT_S, demo.kill)  # a demo that never answers fails the test
        watchdog.start()
        try:
            lines = []
            for line in demo.stderr:
                lines.append(line)
                if line.startswith("panel: "):
                    break
            address = re.search(r"http://127\.[\d.]+:\d+/", lines[-1])
            assert address, "".join(lines)
            with urllib.request.urlopen(address[0], timeout=ANSWER_S) as response:
                assert response.status == 200
            boards = find_command_lines(f"{folder}/{PREFIX}")
            assert any("hil serve" in line for line in boards)
            demo.send_signal(signal.SIGINT)
            remaining_output = demo.stderr.read()
            assert demo.wait() == 0, "".join(lines) + remaining_output
            assert "board at" in remaining_output
            assert "ended after" in remaining_output
        finally:
            watchdog.cancel()
            demo.terminate()  # after a failure: it removes its files
    assert find_command_lines(f"{folder}/{PREFIX}") == find_command_lines(str(runtime)) == []
    leftover_files = [path for path in tmp_path.rglob("*") if path not in (runtime, folder)]
    assert leftover_files == []
    assert not (set(MEMORY.glob(f"{PREFIX}*")) if MEMORY.is_dir() else set()) - before

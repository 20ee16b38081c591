"""Runs of 0, 1 or 2 ticks, and starts that end early: tripped, stopped, or with a driver that fails at once."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

import rtloop
from rtloop.cli import main
from rtloop.engine.memory import ProcessState
from rtloop.errors import UnavailableError
from rtloop.foundation.native import cache
from rtloop.recording.capture.session import Options, Session
from rtloop.supervision import supervisor as supervisor_module
from rtloop.supervision.supervisor import Supervisor
from tests.recording.real_loop import PAPER, RealLoop, changed_configuration
from tests.service.test_python_driver import DRIVER, install
from tests.service.test_run import ROOT, start

pytestmark = pytest.mark.system

NOT_THERE = 66
TRIPPING = ("position_um = 60.0", "position_um = 0.001")
FAILING = ("    def read(self):\n", '    def read(self):\n        raise OSError("cable [off]\\n\\x1b[31m")\n')
FAILING_LATER = (FAILING[0], f"{FAILING[0]}        if self.drive_v:\n            raise OSError('cable [off]')\n")
"""The first tick enters the closed loop and leaves the drive at 0; the read after the second one fails."""


def command_exit_codes(path: Path) -> dict[str, int]:
    """Return the exit code of each command for a recording, by the command's name."""
    file, out = str(path), str(path.with_suffix(""))
    commands = {
        "info": ["info", file],
        "info --json": ["info", file, "--json"],
        "plot": ["plot", file],
        "page": ["plot", file, "--html"],
        **{to: ["export", file, "--to", to] for to in ("csv", "npz", "parquet")},
        "replay": ["replay", file],
        "recover": ["recover", file, "--out", f"{out}-again.mcap"],
    }
    codes = {}
    for name, command in commands.items():
        result = CliRunner().invoke(main, command)
        assert isinstance(result.exception, SystemExit | None), (name, result.exception)
        assert "inf s" not in result.output
        codes[name] = result.exit_code
    return codes


@pytest.mark.parametrize("finished", [True, False], ids=["finished", "left by a killed recorder"])
@pytest.mark.parametrize("text", [PAPER, changed_configuration(TRIPPING)], ids=["driving", "tripped"])
@pytest.mark.parametrize("ticks", [0, 1, 2])
def test_a_recording_of_hardly_any_ticks(tmp_path: Path, ticks: int, text: str, finished: bool) -> None:
    loop, path = RealLoop(text), tmp_path / "short.mcap"
    session = Session(loop.block, path, loop.header, Options(min_free_bytes=0))
    if ticks:
        loop.run(ticks)
    session.drain()
    if finished:
        session.finish("finished")
    else:
        session._write_all()
        path = Path(shutil.copy(f"{path}.part", tmp_path / "left.mcap.part"))
    codes = command_exit_codes(path)
    if ticks:
        assert codes == dict.fromkeys(codes, 0) | ({} if finished else {"replay": 1})
    else:
        assert {name for name, code in codes.items() if code} == {"plot", "page", "replay"}
        assert {codes["plot"], codes["page"], codes["replay"]} == {NOT_THERE}


@pytest.mark.parametrize(
    ("change", "ticks", "clock"),
    [(None, 1, []), (FAILING, 1, ["--unpaced"]), (FAILING_LATER, 3, [])],
    ids=["one tick", "fails at once, unpaced", "fails then"],
)
def test_a_run_of_a_few_ticks(tmp_path: Path, change: tuple[str, str] | None, ticks: int, clock: list[str]) -> None:
    """The driver's error, with driver and tick, is on the screen, in the summary and in the recording."""
    config, environment = install(tmp_path, DRIVER.replace(*change) if change else DRIVER)
    command = [sys.executable, "-m", "rtloop", "run", str(config), "--out", str(tmp_path), *clock]
    command += ["--duration", f"{ticks / 10_000:g}"]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert "Traceback" not in result.stderr, result.stderr
    (path,) = tmp_path.glob("*.mcap")
    recording = rtloop.load(path)
    assert len(recording) == ticks
    final = recording.events[-1]["what"]
    summary = json.loads(CliRunner().invoke(main, ["info", str(path), "--json"]).output)
    if change is None:
        assert (result.returncode, final["driver_error"]) == (0, None), result.stderr
    else:
        error = f"driver 'lag': read failed at tick {ticks - 1}: OSError: cable [off]" + " ?[31m" * (change is FAILING)
        assert result.returncode != 0
        assert f"rtloop: {error}" in result.stderr
        assert (final["driver_error"], summary["driver_error"]) == (error, error)
        assert "cable [off]" in " ".join(result.stdout.split())
    assert command_exit_codes(path)["replay"] == 0


def test_ctrl_c_before_the_loop_runs_ends_well(tmp_path: Path) -> None:
    """Ctrl-C at a random instant of the start leaves no file, or a readable recording."""
    process = start("run", ROOT / "deploy" / "paper.toml", "--out", tmp_path / "out", start_new_session=True)
    wait_s = random.SystemRandom().uniform(0.25, 3.5)
    time.sleep(wait_s)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert "Traceback" not in err, f"Ctrl-C after {wait_s:.3f} s: {err}"
    assert process.returncode == 0, f"Ctrl-C after {wait_s:.3f} s: {err}"
    recorded = list((tmp_path / "out").glob("*"))
    assert recorded or "nothing was driven, nothing is recorded" in err
    for path in recorded:
        assert command_exit_codes(path)["info"] == 0


class StoppedLoop:
    """Process of a loop that was stopped as soon as it was ready: its report arrives with its end."""

    def __init__(self) -> None:
        self.exit_code, self.waited = 0, False

    def wait(self, _: float) -> int:
        self.waited = True
        return 0

    def reports(self) -> list[dict[str, object]]:
        return [{"report": "ready", "realtime": {"scheduler": "SCHED_OTHER"}}] if self.waited else []


def test_a_loop_that_was_stopped_before_anybody_saw_it_ready_was_ready() -> None:
    supervisor: Any = object.__new__(Supervisor)
    supervisor._heart = SimpleNamespace(watch=lambda: None)
    supervisor._loop, supervisor._reports = StoppedLoop(), {}
    supervisor.recorder = SimpleNamespace(state=ProcessState.READY, exit_code=None)
    supervisor._await_ready()
    assert supervisor.realtime == {"scheduler": "SCHED_OTHER"}


class CompilingLoop:
    """Process of a loop that stores a compiled function at each poll, `count` in all, and then is ready if `ends`."""

    def __init__(self, folder: Path, count: int, ends: bool) -> None:
        self.exit_code, self.folder, self.count, self.ends, self.stored = None, folder, count, ends, 0

    def reports(self) -> list[dict[str, object]]:
        if self.stored == self.count:
            return [{"report": "ready", "realtime": {}}] if self.ends else []
        (self.folder / f"{self.stored}.o").touch()
        self.stored += 1
        return []


@pytest.mark.parametrize("is_quiet", [False, True])
def test_the_limit_of_a_start_begins_again_with_each_compiled_function(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_quiet: bool
) -> None:
    """With a limit of 0 s, a start is aborted only after a poll without a newly compiled function."""
    monkeypatch.setattr(cache, "CACHE_FOLDER", tmp_path)
    monkeypatch.setattr(supervisor_module, "START_TIMEOUT_S", 0.0)
    supervisor: Any = object.__new__(Supervisor)
    supervisor._heart = SimpleNamespace(watch=lambda: None)
    supervisor._loop, supervisor._reports = CompilingLoop(tmp_path, 20, ends=not is_quiet), {}
    supervisor.recorder = SimpleNamespace(state=ProcessState.READY, exit_code=None)
    if is_quiet:
        with pytest.raises(UnavailableError, match="loop and recorder were not ready within 0 s"):
            supervisor._await_ready()
    else:
        supervisor._await_ready()
    assert supervisor._loop.stored == 20

"""The commands and files of docs/laws.md work as written, in an empty folder outside of the project."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from rtloop.client import Client
from rtloop.errors import RtloopError
from tests.engine.harness import LoopBench, make_plan

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "laws.md").read_text()
TUTORIAL = (ROOT / "docs" / "tutorial" / "your-own-law.md").read_text()
COMMANDS = re.findall(r"^    \$ (rtloop .*)$", PAGE, re.MULTILINE)
FILE = re.compile(r"^    # (\w+\.py)\n((?:    .*\n|\n)+)", re.MULTILINE)
MAX_LINES = 25
PATIENCE_S = 120.0
PATIENT_SERVICE = f"\n[service]\nstall_ms = {1000.0 * PATIENCE_S}\n"
"""Section with a long stall limit: a host that stalls must not end the run."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return an empty folder outside of the project."""
    return tmp_path


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of a command: it imports rtloop and the folder, and has its sockets in `run`."""
    (folder / "run").mkdir(exist_ok=True)
    return os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{folder}", "RUNTIME_DIRECTORY": str(folder / "run")}


def run_command(folder: Path, command: str) -> str:
    """Run a command of the page, which must succeed, and return its output."""
    words = [sys.executable, "-m", *command.split()]
    result = subprocess.run(words, cwd=folder, env=environment(folder), capture_output=True, text=True, timeout=240)
    assert result.returncode == 0, (command, result.stdout, result.stderr)
    return result.stdout


@pytest.mark.system
def test_a_new_law_runs_replays_and_is_tuned_and_swapped_live(folder: Path):
    offline, live = [line for line in COMMANDS if " ctl " not in line and "serve" not in line], COMMANDS[-3:]
    assert [line.split()[1] for line in offline] == ["laws", "law", "check", "run", "replay"]
    output = [run_command(folder, command) for command in offline]
    assert "integral_resonant" in output[0]
    assert "law 'damping', linear near its rest state, of order 1" in output[2]
    assert "identical" in output[4]
    example = folder / "damping.toml"
    example.write_text(example.read_text().replace("# laws = ", "laws = ") + PATIENT_SERVICE)
    (folder / "other.toml").write_text(example.read_text().replace('file = "damping.py"', 'kind = "pid"'))
    service = subprocess.Popen(
        [sys.executable, "-m", *live[0].removesuffix(" &").split()], cwd=folder, env=environment(folder)
    )
    try:
        deadline_s = time.monotonic() + PATIENCE_S
        while state(folder) != "running":
            assert time.monotonic() < deadline_s
            time.sleep(0.1)
        ticks = [json.loads(run_command(folder, command))["tick"] for command in live[1:]]
    finally:
        service.terminate()
        assert service.wait(60.0) == 0
    assert ticks == sorted(ticks)
    newest = max((folder / "recordings").glob("*.mcap"), key=lambda path: path.stat().st_mtime)
    report = json.loads(run_command(folder, f"rtloop replay {newest} --law damping.py --json"))
    assert report["identical"]
    assert report["ticks"] > ticks[-1]


def state(folder: Path) -> str | None:
    """Return the state of the service, or None if it does not answer."""
    with suppress(RtloopError):
        return Client(folder / "run" / "damping.sock").get("/status")["state"]
    return None


def test_the_pages_law_is_the_new_one_and_fits_on_a_screen(folder: Path, monkeypatch: pytest.MonkeyPatch):
    run_command(folder, "rtloop law new damping")
    files = {name: "\n".join(line[4:] for line in text.splitlines()).strip() for name, text in FILE.findall(PAGE)}
    for other in ("test_notch.py", "conditional.py"):
        files.pop(other)
    for name, text in files.items():
        written = (folder / name).read_text()
        assert written.strip().endswith(text), name
    lines = [line for line in files["damping.py"].splitlines() if line.strip()]
    assert len(lines) <= MAX_LINES
    report = pytest_report(folder, "test_damping.py")
    assert re.search(r"\d+ passed", report), report
    assert "failed" not in report
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    report = pytest_report(folder, "test_damping.py")
    assert re.search(r"\d+ passed, 2 skipped", report), report
    assert "failed" not in report


def test_the_documented_test_of_the_notch_passes_and_finds_a_wrong_notch(folder: Path, monkeypatch: pytest.MonkeyPatch):
    """The wrong notch has half the depth; it is stable and keeps all other promises."""
    match = re.search(r'```python title="notch.py"\n(.*?)```', TUTORIAL, re.DOTALL)
    (page_test,) = [text for name, text in FILE.findall(PAGE) if name == "test_notch.py"]
    assert match is not None
    right, test = match.group(1), "\n".join(line[4:] for line in page_test.splitlines())
    assert right.count("polynomial(self.options.damping)") == 1
    wrong = right.replace("polynomial(self.options.damping)", "polynomial(2 * self.options.damping)")
    for name, text in (("notch", right), ("wrong", wrong)):
        (folder / f"{name}.py").write_text(text)
        (folder / f"test_{name}.py").write_text(test.replace("from notch", f"from {name}"))
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")  # the same bits, without a compiler
    report = pytest_report(folder, "test_notch.py", "test_wrong.py", "-k", "integrator_behind")
    assert "1 failed, 1 passed" in report, report
    assert "FAILED test_wrong.py" in report, report


def test_the_pages_conditional_integration_passes_and_an_unconditional_one_winds_up(folder: Path):
    (page_law,) = [text for name, text in FILE.findall(PAGE) if name == "conditional.py"]
    right = "\n".join(line[4:] for line in page_law.splitlines())
    condition = "if abs(missing_um) < 1e-9 or step_um * missing_um >= 0.0:"
    assert right.count(condition) == 1
    for name, text in (("conditional", right), ("wrong", right.replace(condition, "if True:"))):
        (folder / f"{name}.py").write_text(text)
        (folder / f"test_{name}.py").write_text(
            f"from {name} import Conditional, ConditionalOptions\n"
            "from rtloop.laws.conformance import LawConformance\n"
            "class TestConditional(LawConformance):\n"
            "    law = Conditional(ConditionalOptions(kp=1.5, ki_per_s=150.0, feed=0.5), 1e-4, None)\n"
        )
    report = pytest_report(folder, "test_conditional.py", "test_wrong.py", "-k", "wind or enter or finite")
    assert "1 failed, 7 passed" in report, report
    assert "FAILED test_wrong.py" in report, report
    assert "the law winds up" in report, report


def test_the_pages_conditional_integration_integrates_without_a_limit(folder: Path):
    """The applied command comes back through hysteresis and inverse, with a rounding error that must not stop it."""
    run_command(folder, "rtloop law new conditional")
    (page_law,) = [text for name, text in FILE.findall(PAGE) if name == "conditional.py"]
    (folder / "conditional.py").write_text("\n".join(line[4:] for line in page_law.splitlines()))
    bench = LoopBench(make_plan((folder / "conditional.toml").read_text(), folder))
    levels = bench.column(bench.run(20_000), "x_error_um").reshape(10, 2000)
    assert np.abs(levels[:, :10]).max(axis=1).min() > 10.0
    assert np.abs(levels[:, -200:]).max() < 0.2


def pytest_report(folder: Path, *arguments: str) -> str:
    """Run pytest in a folder and return its report."""
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--basetemp", folder / "basetemp", *arguments],
        cwd=folder, env=environment(folder), capture_output=True, text=True, check=False,
    )  # fmt: skip
    return result.stdout

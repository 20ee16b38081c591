"""Any failure of a user law's code gives one sentence that names it and exit code 78; this process continues."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import ConfigError
from rtloop.laws.limited import process as process_module
from rtloop.laws.limited import trial
from rtloop.laws.limited.process import MAX_OUTPUT_BYTES, PROCESS, LimitedProcess
from rtloop.laws.registry import law_from_text
from rtloop.service.service import Service
from tests.faults.evidence import wait_for
from tests.laws.failing import text as law_text
from tests.laws.test_replay import CONFIGURATION, record_law
from tests.paper_configuration import PAPER, TEXT

LIMIT_S = 0.5
"""Time limit in s for a law that does not end."""
BUILD = "    def build(self):\n"
NASTY = "class Nasty(Exception):\n    def __str__(self):\n        raise OSError('no words')\nraise Nasty\n"
THREAD = "import threading\nthreading.Thread(target=threading.Event().wait, daemon=True).start()\n"
PROCESS_LEFT = "import os, time\nif not (pid := os.fork()):\n    time.sleep(1e6)\nopen('pid', 'w').write(str(pid))\n"
ENDED, CORRECT = (
    "the process that runs this code ended",
    "correct the code, which exits, crashes or exhausts the memory",
)
STOPPED = (
    f"the code used more than {LIMIT_S:g} s of processor time and was stopped; make it faster, or correct a loop that "
    "does not end"
)
SLEPT = (
    f"the code was stopped, because for {3 * LIMIT_S:g} s it did not compute; correct code that sleeps, or waits for a "
    "file, a lock or another process"
)
CHATTY = f"the code printed more than {MAX_OUTPUT_BYTES >> 10} KiB; let it print less"
AT_IMPORT = {
    "never ends": ("while True:\n    pass\n", STOPPED),
    "sleeps for ever": ("import time\ntime.sleep(1e6)\n", SLEPT),
    "exits": ("import sys\nsys.exit(0)\n", "raised SystemExit: 0, in line 2"),
    "is interrupted": ("raise KeyboardInterrupt\n", "raised KeyboardInterrupt, in line 1"),
    "raises what has no words": (NASTY, "raised OSError: no words, in line 3"),
    "ends its process": ("import os\nos._exit(0)\n", f"{ENDED} (exit code 0); {CORRECT}"),
    "reads where nothing is": ("import ctypes\nctypes.string_at(0)\n", f"{ENDED} (SIGSEGV); {CORRECT}"),
    "prints for ever": ("while True:\n    print('x' * 1000)\n", CHATTY),
    "closes stdout": ("import sys\nsys.stdout.close()\n", "closed stdout"),
    "closes the file of stdout": ("import os\nos.close(1)\n", "closed stdout"),
    "replaces stdout": ("import io, sys\nsys.stdout = io.StringIO()\n", "replaced stdout"),
    "leaves a thread": (THREAD, "left 1 thread running"),
}
IN_BUILD = {
    "never ends": ("while True: pass", STOPPED),
    "reads where nothing is": ("import ctypes; ctypes.string_at(0)", f"{ENDED} (SIGSEGV); {CORRECT}"),
    "looks for what is not there": ("{}['gain']", "raised KeyError: 'gain'"),
}


@pytest.fixture(autouse=True)
def limit() -> Iterator[None]:
    """Restore the time limit of user laws after each test."""
    limit_s = PROCESS.limit_s
    yield
    PROCESS.limit_s = limit_s


@pytest.fixture
def write_law(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Return a function that writes a law's text and its configuration, and returns the path of the configuration."""
    monkeypatch.chdir(tmp_path)

    def write(text: str) -> Path:
        Path("mine.py").write_text(text)
        Path("lab.toml").write_text(CONFIGURATION)
        return Path("lab.toml")

    return write


def assert_refused(sentence: str, *arguments: object, file: object = "mine.py") -> None:
    """Assert that a command ends with 78, and with one sentence that names the law and its fault."""
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert (result.exit_code, f"law 'mine' ({file}): {sentence}" in result.stderr) == (78, True), result.output
    assert isinstance(result.exception, SystemExit)
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("passed_s", "computed_s", "waited_s", "is_by_law", "words"),
    [
        (120.0, 9.9, 110.0, None, ""),  # twenty other programs on two processors
        (599.0, 0.1, 598.0, None, ""),
        (29.0, 0.1, 0.0, None, ""),
        (10.1, 10.0, 0.1, True, "used more than 10 s of processor time"),
        (3.0, 10.0, 0.1, True, "used more than 10 s of processor time"),  # on several threads
        (200.0, 10.0, 190.0, True, "used more than 10 s of processor time"),
        (30.5, 0.1, 0.1, True, "for 30 s it did not compute"),
        (600.0, 0.12, 599.0, False, "had only 0.12 s of processor time within 600 s, because the host is too busy"),
    ],
)
def test_the_code_is_judged_by_its_processor_time(monkeypatch, passed_s, computed_s, waited_s, is_by_law, words):
    """The limit is 10 s; None for a process that goes on."""
    times = [(0.0, 2.0, 3.0), (passed_s, 2.0 + computed_s, 3.0 + waited_s)]
    monkeypatch.setattr(process_module._Clock, "_times_s", property(lambda _: times.pop(0)))
    remaining_s, blamed, excess = process_module._Clock(10.0, None).verdict
    assert remaining_s <= 0.0 or is_by_law is None
    assert (blamed, words in excess) == (is_by_law, True) or remaining_s > 0.0


@pytest.mark.parametrize("name", AT_IMPORT)
def test_a_file_that_does_as_it_is_read(name: str):
    """The test calls the function that commands use; tests with commands follow."""
    text, sentence = AT_IMPORT[name]
    PROCESS.limit_s = LIMIT_S if "was stopped" in sentence else 10.0
    with pytest.raises(ConfigError) as refusal:
        trial.try_limited("lab.toml", law_from_text, text + law_text(), "mine.py", "mine")
    assert refusal.value.faults == [f"law 'mine' (mine.py): {sentence}"]
    assert refusal.value.exit_code == 78


@pytest.mark.parametrize("name", IN_BUILD)
def test_a_law_that_does_as_it_is_built(write_law: Callable[[str], Path], name: str):
    line, sentence = IN_BUILD[name]
    PROCESS.limit_s = LIMIT_S if "was stopped" in sentence else 10.0
    assert_refused(sentence, "design", "verify", write_law(law_text().replace(BUILD, f"{BUILD}        {line}\n")))


def test_every_command_that_reads_a_law_is_protected(write_law: Callable[[str], Path]):
    config = write_law("raise SystemExit\n" + law_text())
    for command in (("run", config), ("design", "verify", config), ("doctor", config), ("park", config)):
        assert_refused("raised SystemExit", *command)
    with pytest.raises(ConfigError, match=r"law 'mine' \(mine.py\): raised SystemExit"):
        Service(config)


def test_a_law_that_is_built_for_a_run_is_protected(write_law: Callable[[str], Path]):
    config = write_law(law_text().replace(BUILD, f"{BUILD}        raise SystemExit\n"))
    assert_refused("raised SystemExit", "run", config)


def test_a_replay_reads_a_law_as_carefully(write_law: Callable[[str], Path], tmp_path: Path):
    """The trusted recorded text and the named file exit now; the same text ran without fault when it was recorded."""
    trigger = tmp_path / "trigger"
    text = f"import pathlib\nif pathlib.Path({str(trigger)!r}).exists():\n    raise SystemExit\n" + law_text()
    run = record_law(tmp_path, text)
    trigger.touch()
    assert_refused("raised SystemExit", "replay", run, "--trust-recorded-law", file=run)
    Path("mine.py").write_text(text + "# edited\n")
    assert_refused("raised SystemExit", "replay", run, "--law", "mine.py")


def test_what_a_refused_law_started_is_ended(write_law: Callable[[str], Path]):
    assert_refused("left a process running", "check", write_law(PROCESS_LEFT + law_text()))
    status = Path("/proc", Path("pid").read_text(), "status")
    wait_for(lambda: not status.exists() or "State:\tZ" in status.read_text(), "the end of the process", 10.0)


def test_what_build_prints_is_shown_and_no_part_of_an_answer(write_law: Callable[[str], Path]):
    config = write_law("print('text was read')\n" + law_text().replace(BUILD, f"{BUILD}        print('built')\n"))
    result = CliRunner().invoke(main, ["check", str(config), "--json"])
    assert (result.exit_code, "built" in result.stderr, result.stdout[:1]) == (0, True, "{"), result.output
    assert "text was read" not in result.stdout


def test_a_shipped_law_needs_no_process(monkeypatch: pytest.MonkeyPatch):
    process = LimitedProcess()
    monkeypatch.setattr(trial, "PROCESS", process)
    prepare(parse(TEXT, "paper", PAPER.parent, "paper.toml"))
    assert process.pid is None


def test_an_end_while_another_thread_ends_the_process_leaves_no_traceback(monkeypatch):
    """The case occurs at the exit of a service whose thread still prepares the process."""
    process = LimitedProcess(limit_s=60.0)
    process.prepare_ahead(math.sqrt)
    child: Any = process._process
    wait = child.wait

    def wait_while_another_thread_ends_it():
        monkeypatch.setattr(child, "wait", wait)
        process.end()
        return wait()

    monkeypatch.setattr(child, "wait", wait_while_another_thread_ends_it)
    process.end()
    assert process.pid is None
    assert child.returncode == -signal.SIGKILL
    assert all(pipe.closed for pipe in (child.stdin, child.stdout, child.stderr))


def test_a_preparation_whose_process_another_thread_ends_is_dropped(monkeypatch):
    process = LimitedProcess(limit_s=60.0)
    start = process._start

    def start_and_end():
        start()
        process.end()

    monkeypatch.setattr(process, "_start", start_and_end)
    process.prepare_ahead(math.sqrt)
    assert process.pid is None
    monkeypatch.setattr(process, "_start", start)
    try:
        assert process.run(math.sqrt, 9.0) == 3.0
    finally:
        process.end()

"""The examples in the docstrings of public names print the stated output, on a recording of the paper's loop."""

from __future__ import annotations

import doctest
import inspect
import re
from pathlib import Path
from typing import Any

import pytest

import rtloop
from rtloop.recording.load import Recording
from rtloop.recording.recorded_signals import RecordedSignals
from rtloop.workbench import design as workbench_design
from rtloop.workbench.run_result import RunResult

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
OWNERS = {
    "rtloop.check": rtloop.check,
    "rtloop.design": workbench_design.design,
    "rtloop.load": rtloop.load,
    "rtloop.replay": rtloop.replay,
    "rtloop.run": rtloop.run,
    "Recording": RecordedSignals,
    "Recording.to_pandas": Recording.to_pandas,
}
"""Public names with an example, as they are called."""
FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.REPORT_NDIFF


@pytest.fixture
def folder(tmp_path: Path, paper_run: RunResult, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the working directory: a folder with `run.mcap` and the configurations."""
    assert paper_run.recording is not None
    (tmp_path / "run.mcap").symlink_to(paper_run.recording.paths[0])
    (tmp_path / "deploy").symlink_to(DEPLOY)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_examples(owner: Any) -> tuple[int, str]:
    """Run the examples in the docstring of an object; return their number and the report of failures."""
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    test = doctest.DocTestParser().get_doctest(owner.__doc__, {"rtloop": rtloop}, owner.__qualname__, None, None)
    runner.run(test, out=report.append)
    return len(test.examples), "".join(report)


@pytest.mark.parametrize("name", OWNERS)
@pytest.mark.usefixtures("folder")
def test_the_example_of_a_public_name_prints_what_it_says(name: str):
    if name == "Recording.to_pandas":
        pytest.importorskip("pandas", reason="pandas is not installed (extra `data`)")
    count, report = run_examples(OWNERS[name])
    assert count >= 1
    assert report == ""


def test_every_module_with_an_example_is_listed():
    root = DEPLOY.parent
    files = {file for top in ("rtloop", "drivers", "hil") for file in (root / top).rglob("*.py")}
    with_examples = {file for file in files if re.search(r"^\s*>>> ", file.read_text(encoding="utf-8"), re.MULTILINE)}
    listed = {Path(inspect.getfile(inspect.unwrap(owner))) for owner in OWNERS.values() if inspect.isroutine(owner)}
    names = {file.name for file in listed} | {"recorded_signals.py", "design.py"}
    assert {file.name for file in with_examples} <= names


def test_an_example_that_prints_something_else_is_found():
    def example() -> None:
        """State a wrong output for an example.

        >>> 1 + 1
        3
        """

    count, report = run_examples(example)
    assert count == 1
    assert "- 3" in report

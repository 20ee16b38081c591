"""The examples of docs/python.md run, one after the other, in a folder beside the deployed configurations."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs/python.md").read_text("utf-8"), re.DOTALL | re.MULTILINE)


def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """The example that identifies and designs is left to tests/workbench/test_notebook.py."""
    (tmp_path / "deploy").symlink_to(ROOT / "deploy")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    look, _, error = EXAMPLES
    exec(compile(look, "docs/python.md", "exec"), names)
    assert (names["run"].ticks, len(names["error_um"]), len(names["frame"])) == (10_000, 2001, 2001)
    assert names["replay"].identical
    capsys.readouterr()
    exec(compile(error, "docs/python.md", "exec"), names)
    [printed, comment] = capsys.readouterr().out.strip(), re.search(r"# (.*)$", error, re.MULTILINE)
    assert printed == comment[1]

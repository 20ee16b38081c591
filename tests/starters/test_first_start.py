"""The first start on a machine prints that it compiles; a later start does not."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rtloop.cli.run import TerminalObserver
from rtloop.engine.loop import run_ticks
from rtloop.foundation.native import cache
from rtloop.starters.first_start import LOOP_CODE


def watch_start(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the text that the terminal shows at the start of a run."""
    prepared: Any = SimpleNamespace(plan=None)
    with TerminalObserver().watch(prepared):
        pass
    return capsys.readouterr().err


def test_a_run_with_an_empty_cache_says_that_it_compiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cache, "CACHE_FOLDER", tmp_path)
    (tmp_path / "rtloop.laws.shipped.pid.Pid.output.o").touch()  # by an earlier `rtloop check`
    assert watch_start(capsys).startswith("compiling the loop for this machine, once: ")
    (tmp_path / "rtloop.engine.loop.run_ticks.o").touch()
    assert watch_start(capsys) == ""


def test_the_file_that_tells_a_first_start_is_that_of_the_loop() -> None:
    assert f"{run_ticks._name}.o" == LOOP_CODE

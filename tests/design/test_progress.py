"""What long commands show on a terminal: one line on stderr with the present activity."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest

from rtloop.cli.auto import auto
from rtloop.cli.verify import verify
from tests.laws.test_shipped import DEPLOY
from tests.recording.real_loop import record


class Terminal(io.StringIO):
    """A stream that is a terminal, or is none."""

    def __init__(self, is_terminal: bool) -> None:
        super().__init__()
        self._is_terminal = is_terminal

    def isatty(self) -> bool:
        return self._is_terminal


def shown(monkeypatch: pytest.MonkeyPatch, command, *arguments: object, is_terminal: bool = True) -> str:
    """Return the text on stderr of a command, which must end with 0 or 1."""
    terminal = Terminal(is_terminal)
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with pytest.raises(SystemExit) as ended:
        command.main(list(map(str, arguments)), standalone_mode=False)
    assert ended.value.code in (0, 1)
    return terminal.getvalue()


@pytest.mark.usefixtures("few_simulated_steps")
@pytest.mark.parametrize("is_terminal", [True, False])
def test_verify_shows_its_activity_on_a_terminal_alone(monkeypatch: pytest.MonkeyPatch, is_terminal: bool) -> None:
    text = shown(monkeypatch, verify, DEPLOY / "paper.toml", "--json", is_terminal=is_terminal)
    assert ("judging the linear loops" in text, "simulating steps" in text) == (is_terminal, is_terminal)


@pytest.mark.usefixtures("few_simulated_steps")
def test_auto_shows_its_activity_on_a_terminal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    recordings = [
        record(tmp_path / f"{name}.mcap", (DEPLOY / f"{name}.toml").read_text(encoding="utf-8"), ticks)[0]
        for name, ticks in (("own-stage-sine", 25_000), ("own-stage", 10_000))
    ]
    specs, out = DEPLOY / "own-stage-spec.toml", tmp_path / "made.toml"
    text = shown(monkeypatch, auto, *recordings, "--specs", specs, "--out", out, "--json")
    assert "identifying the stage and synthesising a controller" in text
    assert "simulating steps" in text

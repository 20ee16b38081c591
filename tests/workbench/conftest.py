"""Fixtures: a run that all tests of a file share, and the command line in the test's process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

import rtloop
from rtloop.cli import main
from rtloop.workbench.run_result import RunResult

PAPER = Path(__file__).resolve().parents[2] / "deploy" / "paper.toml"
DURATION_S = 0.7


@pytest.fixture(scope="module")
def paper_run(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """Return a run of the paper's loop for DURATION_S in virtual time."""
    return rtloop.run(PAPER, duration_s=DURATION_S, unpaced=True, folder=tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="session")
def command() -> Callable[..., Result]:
    """Return a function that runs a command; an exit code other than `code` fails the test."""

    def call(*arguments: object, code: int = 0) -> Result:
        result = CliRunner().invoke(main, [str(argument) for argument in arguments])
        assert result.exit_code == code, result.output
        return result

    return call

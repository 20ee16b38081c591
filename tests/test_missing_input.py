"""A missing or unreadable input file ends every command that takes one with exit code 66 and one sentence."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp

import click
import pytest

from rtloop.cli import main
from tests.command_line import run
from tests.users import ROOT_ONLY, VICTIM, as_user

DEPLOY = Path(__file__).resolve().parents[1] / "deploy"
STAGE, SPEC = DEPLOY / "own-stage.toml", DEPLOY / "own-stage-spec.toml"
COMMANDS = {
    "archive info": ["NONE"],
    "archive replay": ["NONE"],
    "campaign boundary": ["NONE", "x"],
    "campaign compare": ["NONE", "NONE"],
    "campaign report": ["NONE"],
    "campaign rerun": ["NONE", "1"],
    "campaign run": ["NONE"],
    "campaign search": ["NONE"],
    "check": ["NONE"],
    "run": ["NONE"],
    "serve": ["NONE"],
    "park": ["NONE"],
    "doctor": ["NONE"],
    "drivers": ["--selftest", "NONE"],
    "info": ["NONE"],
    "replay": ["NONE"],
    "cut": ["NONE"],
    "export": ["NONE", "--to", "npz"],
    "plot": ["NONE"],
    "recover": ["NONE"],
    "import": ["NONE"],
    "identify hysteresis": ["NONE"],
    "identify dynamics": ["NONE"],
    "identify response": ["NONE"],
    "identify resonance": ["NONE"],
    "design auto": ["NONE", "NONE", "--specs", SPEC, "--out", "out.toml"],
    "design compensation": ["NONE", "--actuator", "NONE"],
    "design robust": ["NONE"],
    "design shape": ["NONE"],
    "design synthesise": ["NONE"],
    "design verify": ["NONE"],
    "experiment all": ["NONE"],
    "experiment paper": ["NONE"],
    "experiment run": ["steps", "NONE"],
    "experiment report": ["NONE"],
    "hil serve": ["NONE"],
    "ctl controller": ["x", "NONE"],
    "ctl learn": ["x", "NONE"],
    "ctl waveform": ["x", "NONE"],
}
"""Arguments of each command that takes a file; NONE stands for one that is missing."""
CREATES_FOLDER = {"init"}
"""Commands whose argument is a folder that they create where it is missing."""
OPTIONS = {
    "design auto": ["NONE", "NONE", "--specs", "NONE", "--out", "out.toml"],
    "design compensation": [STAGE, "--actuator", "NONE"],
    "design shape": [STAGE, "--spec", "NONE"],
    "design robust": [SPEC, "--config", "NONE"],
    "design verify": [DEPLOY / "paper.toml", "--spec", "NONE"],
    "experiment run": ["steps", STAGE, "--beside", "NONE"],
    "ctl retune": ["x", "--spec", "NONE"],
}
"""Arguments of commands with a missing file as the value of an option."""


def commands(group: click.Group, prefix: str = "") -> dict[str, click.Command]:
    """All commands below a group by their names."""
    named = {}
    for name, command in group.commands.items():
        is_group = isinstance(command, click.Group)
        named |= commands(command, f"{prefix}{name} ") if is_group else {prefix + name: command}
    return named


@pytest.mark.parametrize(
    ("command", "arguments"),
    [*COMMANDS.items(), *OPTIONS.items()],
    ids=[*COMMANDS, *(f"{name}, option" for name in OPTIONS)],
)
def test_a_missing_file_ends_a_command_with_66(
    command: str, arguments: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*command.split(), *(tmp_path / "none" if argument == "NONE" else argument for argument in arguments))
    assert result.exit_code == 66, result.output
    assert "none" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr


@pytest.fixture(scope="module")
def unreadable() -> Iterator[Path]:
    """A file in a folder for all, which its owner alone may read."""
    folder = Path(mkdtemp(dir="/tmp"))
    folder.chmod(0o777)
    (folder / "none").touch(0o600)
    yield folder / "none"
    rmtree(folder)


@ROOT_ONLY
@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        *((command, arguments) for command, arguments in COMMANDS.items() if command != "import"),
        *OPTIONS.items(),
        ("ctl retune", ["x", "--swap", "NONE"]),
    ],
)
def test_a_file_that_another_user_may_not_read_ends_a_command_with_66(
    command: str, arguments: list[object], unreadable: Path
) -> None:
    """`import` is left out: it reads in a new process, and the other user may have no interpreter to start one."""

    def ask() -> tuple[int, str]:
        os.chdir(unreadable.parent)
        result = run(*command.split(), *(unreadable if argument == "NONE" else argument for argument in arguments))
        return result.exit_code, result.stderr

    exit_code, message = as_user(VICTIM, ask)
    assert exit_code == 66, message
    assert f"{unreadable}" in message
    assert "Permission denied" in message


def test_every_command_that_takes_a_file_is_tried() -> None:
    with_file = {
        name
        for name, command in commands(main).items()
        for parameter in command.params
        if isinstance(parameter, click.Argument) and isinstance(parameter.type, click.Path | click.File)
    }
    assert with_file - CREATES_FOLDER <= COMMANDS.keys()


def test_a_missing_specification_is_named_with_the_key_that_names_it(tmp_path: Path) -> None:
    config, text = tmp_path / "paper.toml", (DEPLOY / "paper.toml").read_text(encoding="utf-8")
    (line,) = [line for line in text.splitlines() if line.startswith("specification = ")]
    config.write_text(text.replace(line, 'specification = "none.toml"'))
    for command in (["check", config], ["design", "verify", config]):
        result = run(*command)
        assert result.exit_code == 66, result.output
        assert f"{config}: axis.x.specification: " in result.stderr

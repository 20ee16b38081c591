"""`rtloop init`: the files of each kind run as they are, none is overwritten, a mistake is one sentence."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rtloop.cli import main
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from tests.drivers.installing import write_distribution

ROOT = Path(__file__).resolve().parents[2]
KINDS = ("paper", "stage", "law", "driver")


def init(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["init", *map(str, arguments)])


def install_driver(folder: Path) -> None:
    """Install the package of a folder as pip would, by its pyproject.toml."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    points = project["entry-points"]["rtloop.drivers"]
    lines = "".join(f"{kind} = {place}\n" for kind, place in points.items())
    write_distribution(folder, project["name"], project["version"], f"[rtloop.drivers]\n{lines}")


@pytest.mark.parametrize("kind", KINDS)
def test_every_configuration_can_run(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "new" / kind
    assert init(folder, "--kind", kind).exit_code == 0
    if kind == "driver":
        install_driver(folder)
        monkeypatch.syspath_prepend(folder)
    configurations = [path for path in folder.glob("*.toml") if "loop" in tomllib.loads(path.read_text())]
    assert configurations
    for path in configurations:
        assert path.read_text().startswith("#:schema ./rtloop.schema.json\n")
        prepare(load(path))
    assert (folder / "rtloop.schema.json").is_file()


def test_the_files_of_the_paper_are_the_examples_and_name_each_other(tmp_path: Path) -> None:
    from rtloop.campaigns.campaign_file import load_campaign
    from rtloop.design.synthesis.specification_file import load_specification

    init(tmp_path)
    for path in tmp_path.glob("*.toml"):
        assert tomllib.loads(path.read_text()) == tomllib.loads((ROOT / "deploy" / path.name).read_text())
        assert "deploy/paper" not in path.read_text()
    load_specification(tmp_path / "paper-spec.toml")
    load_campaign(tmp_path / "campaign.toml")


def test_an_existing_file_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    (tmp_path / "stage-spec.toml").write_text("mine")
    result = init(tmp_path, "--kind", "stage")
    assert result.exit_code == 73
    assert "stage-spec.toml: the file exists already and is not overwritten" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["stage-spec.toml"]
    assert (tmp_path / "stage-spec.toml").read_text() == "mine"


def test_two_kinds_share_a_folder_and_its_schema(tmp_path: Path) -> None:
    init(tmp_path)
    (tmp_path / "rtloop.schema.json").write_text("{}")
    assert init(tmp_path, "--kind", "stage").exit_code == 0
    assert (tmp_path / "rtloop.schema.json").read_text() == "{}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--kind", "stage", "--resonance-hz", -5), "--resonance-hz: value is -5; allowed: 1 … 10000 Hz"),
        (("--kind", "stage", "--rate-hz", "nan"), "--rate-hz: value is nan; allowed: 3200 … 100000 Hz"),
        (("--damping", 0.1), "--damping: not allowed with --kind paper; allowed with --kind stage"),
        (("--name", "mine"), "--name: not allowed with --kind paper; allowed with --kind law and --kind driver"),
        (("--kind", "law", "--name", "My Law"), "value is 'My Law'; allowed: small letters"),
    ],
)
def test_a_mistake_is_one_sentence(arguments: tuple[object, ...], message: str, tmp_path: Path) -> None:
    result = init(tmp_path / "new", *arguments)
    assert result.exit_code == 2
    assert message in result.output
    assert not (tmp_path / "new").exists()


def test_the_commands_to_type_next_exist(tmp_path: Path) -> None:
    for kind in KINDS:
        printed = init(tmp_path / kind, "--kind", kind).output.partition("Next:\n")[2]
        lines = [line.split() for line in printed.splitlines()]
        assert lines[0] == ["cd", str(tmp_path / kind)]
        for program, *words in lines[1:]:
            command = main
            while program == "rtloop" and words and words[0] in getattr(command, "commands", {}):
                command = command.commands[words.pop(0)]  # type: ignore[attr-defined]
            assert program != "rtloop" or command is not main
            files = [
                word
                for word in words
                if word.endswith((".toml", ".py")) and word not in ("controller.toml", "designed.toml")
            ]
            assert [name for name in files if not (tmp_path / kind / name).is_file()] == []


def test_the_driver_keeps_the_contract(tmp_path: Path) -> None:
    init(tmp_path, "--kind", "driver", "--name", "lab_card")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error", "--rootdir", tmp_path]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*command, "test_lab_card.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.stdout.strip().splitlines()[-1].startswith("13 passed"), done.stdout

"""`rtloop init`: the files of each kind run unchanged, none is overwritten, a mistake is one sentence."""

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
from tests.drivers.installing import built_modules, write_distribution

ROOT = Path(__file__).resolve().parents[2]
KINDS = ("paper", "stage", "law", "driver")


def init(*arguments: object) -> Result:
    """Run `rtloop init` with `arguments` in this process and return the result."""
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
        (("--kind", "stage", "--drive-min-v", 1), "--drive-min-v: value is 1; allowed: -10 … 0 V (minus --drive-v"),
        (("--kind", "stage", "--hysteresis-percent", 50), "--hysteresis-percent: value is 50; allowed: 0 … 30 %"),
        (("--kind", "stage", "--sensor-um-per-v", 0.5), "--sensor-um-per-v: value is 0.5; allowed: 1 … 200 µm/V"),
        (
            ("--kind", "driver", "--config", "x.toml"),
            "--config: not allowed with --kind driver; allowed with --kind law",
        ),
        (("--kind", "law", "--config", "elsewhere/x.toml"), "allowed: a file directly in this folder"),
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
                if word.endswith((".toml", ".py")) and word not in ("controller.toml", "designed.toml", "robust.toml")
            ]
            assert [name for name in files if not (tmp_path / kind / name).is_file()] == []


def test_a_law_takes_a_stage_of_ones_own(tmp_path: Path) -> None:
    init(tmp_path, "--kind", "stage", "--drive-min-v", -2, "--resonance-hz", 400)
    stage_text = (tmp_path / "stage.toml").read_text()
    result = init(tmp_path, "--kind", "law", "--name", "damping", "--config", tmp_path / "stage.toml")
    assert result.exit_code == 0, result.output
    text = (tmp_path / "damping.toml").read_text()
    stage, law_example = tomllib.loads(stage_text), tomllib.loads(text)
    ki_per_s = stage["axis"][0]["controller"]["ki_per_s"]
    assert law_example["axis"][0].pop("controller") == {"file": "damping.py", "ki_per_s": ki_per_s}
    del stage["axis"][0]["controller"]
    assert law_example == stage
    assert text.startswith("#:schema ./rtloop.schema.json\n")
    assert text.count("#:schema") == 1
    assert "integrator" not in text.lower()
    running = prepare(load(tmp_path / "damping.toml")).checks[0].running
    assert running is not None
    assert running.stable


def test_law_new_takes_a_stage_too_in_the_folder_of_the_law_alone(tmp_path: Path) -> None:
    init(tmp_path, "--kind", "stage", "--drive-min-v", -2, "--resonance-hz", 400)
    arguments = ["law", "new", "damping", "--config", str(tmp_path / "stage.toml")]
    elsewhere = CliRunner().invoke(main, [*arguments, "--out", str(tmp_path / "other")])
    assert elsewhere.exit_code == 2
    assert "allowed: a file directly in this folder" in elsewhere.output
    assert not (tmp_path / "other").exists()
    result = CliRunner().invoke(main, [*arguments, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    stage, law = (tomllib.loads((tmp_path / f"{name}.toml").read_text()) for name in ("stage", "damping"))
    assert law["driver"] == stage["driver"]
    assert law["axis"][0]["limits"] == stage["axis"][0]["limits"]
    assert law["axis"][0]["controller"]["file"] == "damping.py"


def test_a_law_on_another_controllers_stage_begins_slowly_and_without_its_prefilter(tmp_path: Path) -> None:
    init(tmp_path)
    assert init(tmp_path, "--kind", "law", "--config", tmp_path / "robust.toml").exit_code == 0
    axis = tomllib.loads((tmp_path / "my_law.toml").read_text())["axis"][0]
    assert axis["controller"] == {"file": "my_law.py", "ki_per_s": 1.0}
    assert "prefilter" not in axis
    running = prepare(load(tmp_path / "my_law.toml")).checks[0].running
    assert running is not None
    assert running.stable


@pytest.mark.parametrize("kind", ["law", "driver"])
def test_the_test_runs_with_the_python_of_rtloop(kind: str, tmp_path: Path) -> None:
    lines = [line.strip() for line in init(tmp_path, "--kind", kind).output.splitlines()]
    name = {"law": "my_law", "driver": "my_card"}[kind]
    assert lines[-2:] == ["pip install pytest", f"python -m pytest test_{name}.py"]


def test_the_package_installs_the_modules_that_it_lists(tmp_path: Path) -> None:
    """The line in the template's comment adds a card's library to the installed package."""
    init(tmp_path, "--kind", "driver", "--name", "lab_card")
    (tmp_path / "my_library.py").write_text("")
    assert built_modules(tmp_path) == ["lab_card.py"]
    project = tmp_path / "pyproject.toml"
    text = project.read_text()
    example = next(line.partition("py-modules")[2] for line in text.splitlines() if line.startswith("# after"))
    project.write_text(text.replace('\npy-modules = ["lab_card"]', f"\npy-modules{example}"))
    assert built_modules(tmp_path) == ["lab_card.py", "my_library.py"]


def test_the_driver_keeps_the_contract(tmp_path: Path) -> None:
    init(tmp_path, "--kind", "driver", "--name", "lab_card")
    options = ("-q", "-p", "no:cacheprovider", "-W", "error", "--rootdir", tmp_path, f"--basetemp={tmp_path}/basetemp")
    command = [sys.executable, "-m", "pytest", *options]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        [*command, "test_lab_card.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
    )
    assert result.stdout.strip().splitlines()[-1].startswith("13 passed"), result.stdout

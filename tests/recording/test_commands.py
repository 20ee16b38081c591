"""The commands on recordings as a user meets them: what they say, what they write, how they end."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from rtloop.cli import main
from rtloop.recording.load import load
from tests.asked import answer, run
from tests.recording.hand_made_loop import make_rows, write_recording
from tests.recording.real_loop import PAPER, changed, record, scheduled
from tests.recording.tamper import rewrite
from tests.recording.test_damage import WRONG

TICKS = 21_000


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("commands") / "run.mcap", scheduled(), TICKS)[0]


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return record(tmp_path_factory.mktemp("parts") / "run.mcap", PAPER, TICKS, rotate_s=1.0)


@pytest.mark.parametrize("command", ["info", "replay", "plot", "recover", "export"])
@pytest.mark.parametrize("case", WRONG)
def test_bad_input_gets_one_message_and_66(case: str, command: str, tmp_path: Path):
    make, message = WRONG[case]
    path = tmp_path / "run.mcap"
    make(path)
    result = run(command, path, *(["--to", "csv"] if command == "export" else []))
    assert result.exit_code == 66
    assert result.stdout == ""
    assert message in result.stderr
    assert result.stderr.startswith(f"rtloop: {path}: ")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("options", [["--config", "absent.toml"], ["--resimulate", "--config", "absent.toml"]])
def test_a_missing_configuration_ends_with_66(options: list[str], path: Path):
    assert run("replay", path, *options).exit_code == 66


def test_a_pattern_without_files_ends_with_66(tmp_path: Path):
    result = run("info", tmp_path / "run-*.mcap")
    assert (result.exit_code, "no such file" in result.stderr) == (66, True)


def test_replay_says_identical_or_what_differs(path: Path, tmp_path: Path):
    verdict = answer("replay", path)
    assert (verdict["ticks"], verdict["identical"], verdict["first_difference"]) == (TICKS, True, None)
    assert "identical" in run("replay", path).stdout

    def nudge(rows: np.ndarray) -> None:
        rows[rows[:, 0] == 777, -4] += 1e-9  # the drive

    changed_file = rewrite(path, tmp_path / "run.mcap", rows=nudge)
    verdict = answer("replay", changed_file, code=1)
    assert verdict["identical"] is False
    assert set(verdict["first_difference"]) == {"tick", "signal", "recorded", "replayed"}
    assert (verdict["first_difference"]["tick"], verdict["first_difference"]["signal"]) == (777, "x_drive_v")
    assert "tick 777, x_drive_v" in run("replay", changed_file).stdout


def test_replay_with_another_law_ends_with_0(path: Path, tmp_path: Path):
    other = tmp_path / "other.toml"
    other.write_text(changed(("gain = 0.016", "gain = 0.012")))
    report = answer("replay", path, "--config", other)
    assert report["signals"]["x_drive_v"]["max"] > 0.0
    assert "x_drive_v" in run("replay", path, "--config", other).stdout
    report = answer("replay", path, "--config", other, "--resimulate")
    assert set(report["axes"][0]) == {"name", "recorded", "resimulated"}
    assert "resimulated" in run("replay", path, "--resimulate").stdout


def test_a_rig_that_is_not_simulated_ends_with_78(tmp_path: Path):
    path = write_recording(tmp_path / "run.mcap", make_rows(10), configuration=PAPER.replace('"sim"', '"absent"'))
    assert run("replay", path, "--resimulate").exit_code == 78


def test_info_of_a_rotated_recording(parts: list[Path]):
    summary = answer("info", *reversed(parts))
    assert (summary["ticks_logged"], summary["ticks_lost"], summary["complete"]) == (TICKS, 0, True)
    assert summary["parts"] == [str(part) for part in parts]
    assert summary["size_bytes"] == sum(part.stat().st_size for part in parts)
    single = [answer("info", part) for part in parts]
    assert sum(one["ticks_logged"] for one in single) == TICKS
    assert all(one["complete"] for one in single)
    late = answer("info", *parts[1:])
    assert (late["ticks_logged"], late["ticks_lost"], late["complete"]) == (TICKS - 10_000, 0, False)
    assert late["problems"] == ["part 1 of the run is missing"]
    assert answer("info", parts[0], parts[2])["ticks_lost"] == 10_000
    assert "parts" in run("info", parts[0].parent / "run-*.mcap").stdout


def test_replay_of_a_rotated_recording(parts: list[Path]):
    assert answer("replay", parts[0].parent / "run-*.mcap")["ticks"] == TICKS
    verdict = answer("replay", *parts[1:])
    assert (verdict["identical"], verdict["problems"]) == (True, ["part 1 of the run is missing"])
    assert run("replay", parts[0], parts[0]).exit_code == 66


def test_recover(path: Path, tmp_path: Path):
    part = tmp_path / "run.mcap.part"
    part.write_bytes(path.read_bytes()[:-1000])
    report = answer("recover", part)
    assert (report["output"], report["ticks"]) == (str(tmp_path / "run.mcap"), TICKS)
    assert answer("replay", report["output"])["identical"]
    result = run("recover", part)
    assert (result.exit_code, "exists already" in result.stderr) == (73, True)
    other = run("recover", part, "--out", tmp_path / "other.mcap")
    assert (other.exit_code, "21,000 ticks recovered" in other.stdout) == (0, True)
    with (tmp_path / "other.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert all(index.message_index_offsets for index in summary.chunk_indexes)


def test_a_whole_recording_is_not_recovered(path: Path, tmp_path: Path):
    done = run("recover", path, "--out", tmp_path / "copy.mcap")
    assert (done.exit_code, "is whole, there was nothing to recover" in " ".join(done.stdout.split())) == (0, True)
    assert "recovered from" not in done.stdout


@pytest.mark.parametrize("to", ["csv", "parquet", "npz"])
def test_export(to: str, path: Path, tmp_path: Path):
    copy = Path(shutil.copy(path, tmp_path))
    report = answer("export", copy, "--to", to)
    assert (report["output"], report["ticks"]) == (str(tmp_path / f"run.{to}"), TICKS)
    assert run("export", copy, "--to", to).exit_code == 73
    assert run("export", copy, "--to", to, "--out", tmp_path / f"other.{to}").exit_code == 0
    assert run("export", copy, "--to", "xlsx").exit_code == 2


def test_plot_writes_a_picture_or_a_page(path: Path, tmp_path: Path):
    copy = Path(shutil.copy(path, tmp_path))
    assert answer("plot", copy)["output"] == str(tmp_path / "run.png")
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    output = tmp_path / "part.html"
    answer("plot", copy, "--html", "--from", "0.5", "--until", "0.6", "--out", output)
    check_page(output, ticks=1_001)
    assert run("plot", copy, "--from", "100").exit_code == 66
    assert run("plot", copy, "--until", "0").exit_code == 2
    assert run("plot", copy, "--out", tmp_path / "absent" / "a.png").exit_code == 73


def test_a_page_shows_any_name_as_it_is(path: Path, tmp_path: Path):
    copy = shutil.copy(path, tmp_path / "DATA of <i>Ann & Bob {{ 1 + 1 }}.mcap")
    answer("plot", copy, "--html", "--out", tmp_path / "odd.html")
    data, page = data_of(tmp_path / "odd.html"), (tmp_path / "odd.html").read_text()
    assert data["about"].startswith("DATA of <i>Ann & Bob {{ 1 + 1 }}.mcap")
    assert "<i>" not in page
    assert page.count("application/json") == 1


def data_of(page: Path) -> dict[str, Any]:
    text = page.read_text()
    return json.loads(text[text.index('"application/json">') + 19 : text.index("</script>")])


def check_page(page: Path, ticks: int) -> None:
    """Self-contained, and the embedded numbers are the recorded ones."""
    import base64

    text = page.read_text()
    assert "http" not in text
    assert "src=" not in text
    data = data_of(page)
    time_s = np.frombuffer(base64.b64decode(data["time_s"]))
    assert len(time_s) == ticks
    recording = load(page.parent / "run.mcap")
    reference = np.frombuffer(base64.b64decode(data["panels"][0]["traces"][0]["low"]), np.float32)
    assert np.array_equal(reference, recording["x_reference_um"][5_000:6_001].astype(np.float32))
    assert [event["label"] for event in data["events"]] == ["closed loop"]


def test_every_command_explains_itself():
    commands: dict[str, Callable[..., Any]] = main.commands  # type: ignore[assignment]
    for name in commands:
        assert run(name, "--help").exit_code == 0

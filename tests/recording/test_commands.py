"""The commands on recordings: their output, their files and their exit codes."""

from __future__ import annotations

import base64
import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rich.console import Console

from rtloop.cli import main
from rtloop.recording.load import load
from rtloop.recording.replay.verdict import ReplayReport
from rtloop.workbench.replay_text import print_replay
from tests.command_line import answer, run
from tests.recording.conftest import EVENTFUL_TICKS
from tests.recording.hand_made_loop import make_rows, write_recording
from tests.recording.real_loop import PAPER, changed_configuration, record
from tests.recording.tamper import rewrite
from tests.recording.test_damage import INVALID_FILES

TICKS = 21_000


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of a rotated run of TICKS ticks, one second each."""
    return record(tmp_path_factory.mktemp("parts") / "run.mcap", PAPER, TICKS, rotate_s=1.0)


@pytest.fixture
def copy(eventful: Path, tmp_path: Path) -> Path:
    """A copy of the eventful recording in the test's folder."""
    return Path(shutil.copy(eventful, tmp_path))


@pytest.mark.parametrize("command", ["info", "replay", "plot", "recover", "export"])
@pytest.mark.parametrize("case", INVALID_FILES)
def test_an_invalid_file_gets_one_message_and_66(case: str, command: str, tmp_path: Path):
    make, message = INVALID_FILES[case]
    path = tmp_path / "run.mcap"
    make(path)
    result = run(command, path, *(["--to", "csv"] if command == "export" else []))
    assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (66, "", 1)
    assert result.stderr.startswith(f"rtloop: {path}: ")
    assert message in result.stderr


@pytest.mark.parametrize("options", [["--config", "absent.toml"], ["--resimulate", "--config", "absent.toml"]])
def test_a_missing_configuration_ends_with_66(options: list[str], eventful: Path):
    assert run("replay", eventful, *options).exit_code == 66


def test_a_pattern_without_files_ends_with_66(tmp_path: Path):
    result = run("info", tmp_path / "run-*.mcap")
    assert (result.exit_code, "no such file" in result.stderr) == (66, True)


def test_replay_prints_identical_or_the_first_difference(eventful: Path, tmp_path: Path):
    verdict = answer("replay", eventful)
    assert (verdict["ticks"], verdict["identical"], verdict["first_difference"]) == (EVENTFUL_TICKS, True, None)
    assert "identical" in run("replay", eventful).stdout

    def change_drive(rows: np.ndarray) -> None:
        rows[rows[:, 0] == 777, -4] += 1e-9

    path = rewrite(eventful, tmp_path / "run.mcap", rows=change_drive)
    verdict = answer("replay", path, code=1)
    difference = verdict["first_difference"]
    assert (verdict["identical"], difference.keys()) == (False, {"tick", "signal", "recorded", "replayed"})
    assert (difference["tick"], difference["signal"]) == (777, "x_drive_v")
    assert "tick 777, x_drive_v" in run("replay", path).stdout


@pytest.mark.parametrize(("recorded", "replayed", "text"), [
    (None, None, "tick 9, end of the run (1 tick and "),
    (1.5, None, "end of the run: recorded 1.5, replayed None (1 tick"),
])  # fmt: skip
def test_a_difference_without_values_prints_no_values(
    recorded: float | None, replayed: float | None, text: str
) -> None:
    difference = {"tick": 9, "signal": "end of the run", "recorded": recorded, "replayed": replayed}
    printed = io.StringIO()
    report = ReplayReport(ticks=1, first_difference=difference, not_judged=["times"])
    print_replay(Console(file=printed, width=200), Path("run.mcap"), report)
    assert text in printed.getvalue()


def test_replay_with_another_law_ends_with_0(eventful: Path, tmp_path: Path):
    configuration = tmp_path / "other.toml"
    configuration.write_text(changed_configuration(("gain = 0.016", "gain = 0.012")))
    assert answer("replay", eventful, "--config", configuration)["signals"]["x_drive_v"]["max"] > 0.0
    assert "x_drive_v" in run("replay", eventful, "--config", configuration).stdout
    report = answer("replay", eventful, "--config", configuration, "--resimulate")
    assert set(report["axes"][0]) == {"name", "recorded", "resimulated"}
    assert "resimulated" in run("replay", eventful, "--resimulate").stdout


def test_resimulation_without_a_simulated_rig_ends_with_78(tmp_path: Path):
    path = write_recording(tmp_path / "run.mcap", make_rows(10), configuration=PAPER.replace('"sim"', '"absent"'))
    assert run("replay", path, "--resimulate").exit_code == 78


def test_info_combines_the_files_of_a_rotated_recording(parts: list[Path]):
    def figures(*paths: Path) -> tuple[int, int, bool]:
        summary = answer("info", *paths)
        return summary["ticks_logged"], summary["ticks_lost"], summary["complete"]

    summary = answer("info", *reversed(parts))
    assert figures(*reversed(parts)) == (TICKS, 0, True)
    sizes = sum(part.stat().st_size for part in parts)
    assert (summary["parts"], summary["size_bytes"]) == ([str(part) for part in parts], sizes)
    single = [figures(part) for part in parts]
    assert (sum(ticks for ticks, _, _ in single), all(complete for _, _, complete in single)) == (TICKS, True)
    assert figures(*parts[1:]) == (TICKS - 10_000, 0, False)
    assert answer("info", *parts[1:])["problems"] == ["file 1 of the run is missing"]
    assert answer("info", parts[0], parts[2])["ticks_lost"] == 10_000
    assert "parts" in run("info", parts[0].parent / "run-*.mcap").stdout


def test_replay_combines_the_files_of_a_rotated_recording(parts: list[Path]):
    assert answer("replay", parts[0].parent / "run-*.mcap")["ticks"] == TICKS
    verdict = answer("replay", *parts[1:])
    assert (verdict["identical"], verdict["problems"]) == (True, ["file 1 of the run is missing"])
    assert run("replay", parts[0], parts[0]).exit_code == 66


def test_recover_writes_a_complete_file_once(eventful: Path, tmp_path: Path):
    part, output = tmp_path / "run.mcap.part", tmp_path / "other.mcap"
    part.write_bytes(eventful.read_bytes()[:-1000])
    report = answer("recover", part)
    assert (report["output"], report["ticks"]) == (str(tmp_path / "run.mcap"), EVENTFUL_TICKS)
    assert answer("replay", report["output"])["identical"]
    result = run("recover", part)
    assert (result.exit_code, "exists already" in result.stderr) == (73, True)
    result = run("recover", part, "--out", output)
    assert (result.exit_code, f"{EVENTFUL_TICKS:,} ticks recovered" in result.stdout) == (0, True)
    with output.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert all(index.message_index_offsets for index in summary.chunk_indexes)


@pytest.mark.parametrize(("gaps", "complete"), [({}, False), ({"gaps": [[3, 5]]}, False), ({"gaps": []}, True)])
def test_a_run_with_a_recovered_file_is_complete_if_the_file_says_that_it_has_no_gaps(
    gaps: dict[str, list[list[int]]], complete: bool, parts: list[Path], tmp_path: Path
):
    def recover(event: dict[str, Any]) -> None:
        """Change the event that ends a file into that of a recovered file with `gaps`."""
        event["kind"] = "recovered"
        event["what"] |= {"result": "recovered", "complete": False}
        event["what"].pop("gaps", None)
        event["what"].update(gaps)

    first = rewrite(parts[0], tmp_path / parts[0].name, final_event=recover)
    summary = answer("info", first, *parts[1:])
    assert (summary["ticks_logged"], summary["ticks_lost"], summary["complete"]) == (TICKS, 0, complete)


def test_a_complete_recording_is_not_recovered(eventful: Path, tmp_path: Path):
    result = run("recover", eventful, "--out", tmp_path / "copy.mcap")
    assert (result.exit_code, "is complete, nothing had to be recovered" in " ".join(result.stdout.split())) == (
        0,
        True,
    )
    assert "recovered from" not in result.stdout


@pytest.mark.parametrize("to", ["csv", "parquet", "npz"])
def test_export_writes_a_file_once(to: str, copy: Path, tmp_path: Path):
    report = answer("export", copy, "--to", to)
    assert (report["output"], report["ticks"]) == (str(tmp_path / f"run.{to}"), EVENTFUL_TICKS)
    assert run("export", copy, "--to", to).exit_code == 73
    assert run("export", copy, "--out", tmp_path / f"other.{to}").exit_code == 0
    assert (tmp_path / f"other.{to}").read_bytes() == (tmp_path / f"run.{to}").read_bytes()
    assert run("export", copy, "--to", "xlsx").exit_code == 2
    for more in ((), ("--out", tmp_path / "other.xlsx")):
        refused = run("export", copy, *more)
        assert (refused.exit_code, "one of the endings .csv, .parquet, .npz, .mat, .h5" in refused.output) == (2, True)


def test_plot_writes_a_picture_or_a_page(copy: Path, tmp_path: Path):
    assert answer("plot", copy)["output"] == str(tmp_path / "run.png")
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    output = tmp_path / "part.html"
    answer("plot", copy, "--html", "--from", "0.5", "--until", "0.6", "--out", output)
    check_page(output, ticks=1_001)
    for code, arguments in (
        (66, ("--from", "100")),
        (2, ("--until", "0")),
        (73, ("--out", tmp_path / "absent" / "a.png")),
    ):
        assert run("plot", copy, *arguments).exit_code == code


def test_a_page_shows_any_name_unchanged(eventful: Path, tmp_path: Path):
    name, page = "DATA of <i>Ann & Bob {{ 1 + 1 }}.mcap", tmp_path / "odd.html"
    answer("plot", shutil.copy(eventful, tmp_path / name), "--html", "--out", page)
    assert page_data(page)["about"].startswith(name)
    assert ("<i>" in page.read_text(), page.read_text().count("application/json")) == (False, 1)


def page_data(page: Path) -> dict[str, Any]:
    """Return the JSON data that a page embeds."""
    text = page.read_text()
    return json.loads(text[text.index('"application/json">') + 19 : text.index("</script>")])


def check_page(page: Path, ticks: int) -> None:
    """Require a self-contained page with the numbers of `run.mcap` beside it."""
    assert not any(word in page.read_text() for word in ("http", "src="))
    data, recording = page_data(page), load(page.parent / "run.mcap")
    assert len(np.frombuffer(base64.b64decode(data["time_s"]))) == ticks
    reference = np.frombuffer(base64.b64decode(data["panels"][0]["traces"][0]["low"]), np.float32)
    assert np.array_equal(reference, recording["x_reference_um"][5_000:6_001].astype(np.float32))
    assert [event["label"] for event in data["events"]] == ["closed loop"]


@pytest.mark.parametrize("name", main.commands)  # type: ignore[attr-defined]
def test_every_command_has_a_help_text(name: str):
    assert run(name, "--help").exit_code == 0

"""Recordings with a user law: replayed with the installed law, refused without it; its text never runs unasked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import rtloop
from rtloop.cli import main
from rtloop.configuration.laws import Library
from rtloop.kernel.memory import LawRecords
from rtloop.laws.registry import LawReference, laws_in
from rtloop.recording.capture.session import Session
from rtloop.recording.errors import RecordingError
from rtloop.recording.replay.laws import TrustedLaws
from rtloop.recording.replay.replay import replay
from tests.laws.failing import text as law_text
from tests.recording.real_loop import Options, RealLoop

CONFIGURATION = """
[loop]
rate_hz = 10000
laws = ["pid"]
[driver]
kind = "sim"
seed = 3
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
[[axis]]
name = "x"
[axis.feedforward]
thresholds_v = [0.0]
weights_um_per_v = [4.0]
[axis.controller]
file = "mine.py"
[axis.reference]
kind = "sine"
amplitude = 5.0
frequency_hz = 20.0
"""
TICKS = 12_000


def record_law(folder: Path, law: str, change=lambda header: None) -> Path:
    """Record a law from a file, then remove the file; `change` edits the header. Return the recording's path."""
    (folder / "mine.py").write_text(law)
    loop = RealLoop(CONFIGURATION, folder)
    change(loop.header)
    path = folder / "run.mcap"
    session = Session(loop.block, path, loop.header, Options(min_free_bytes=0))
    for _ in range(4):
        loop.run(TICKS // 4)
        while session.cursor < loop.tick:  # one drain takes no more than a buffer
            session.drain()
            session.write_due()
    loop.end()
    session.finish("finished")
    (folder / "mine.py").unlink()
    return path


def marking_law(folder: Path) -> str:
    """Return the text of a law that writes the file `was-run` in the folder when the text is run."""
    return f"import pathlib\npathlib.Path({str(folder / 'was-run')!r}).write_text('run')\n" + law_text()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the path of a recording of the marking law, whose file is gone."""
    folder = tmp_path_factory.mktemp("law")
    path = record_law(folder, marking_law(folder))
    (folder / "was-run").unlink()
    return path


def run(*arguments: object):
    """Run `rtloop` with `arguments` in this process and return the result."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_the_header_holds_the_text_and_its_digest(recording: Path):
    laws = {law["name"]: law for law in rtloop.load(recording).header["law"]["laws"]}
    assert set(laws) == {"prandtl_ishlinskii", "transfer", "pid", "mine"}
    assert laws["mine"]["text"] == marking_law(recording.parent)
    assert "text" not in laws["pid"]


def test_a_law_that_is_not_here_is_said_and_not_run(recording: Path):
    for arguments in (("replay", recording), ("replay", recording, "--resimulate")):
        result = run(*arguments)
        assert result.exit_code == 66, result.output
        assert "law 'mine': no installed law equals the law that ran" in result.output
        assert "--trust-recorded-law" in result.output
    for arguments in (
        ("info", recording),
        ("export", recording, "--to", "npz", "--out", recording.parent / "out.npz"),
    ):
        assert run(*arguments).exit_code == 0
    assert not (recording.parent / "was-run").exists()


@pytest.fixture
def law_file(recording: Path) -> Iterator[Path]:
    """Yield the file from which the law ran, restored for one test."""
    file = recording.parent / "mine.py"
    file.write_text(marking_law(recording.parent))
    yield file
    file.unlink()
    (recording.parent / "was-run").unlink(missing_ok=True)


def test_the_law_is_taken_from_the_file_that_it_ran_from(
    recording: Path, law_file: Path, monkeypatch: pytest.MonkeyPatch
):
    """The working folder does not matter; with --resimulate the configuration's `file` means the same law."""
    monkeypatch.chdir("/")
    report = json.loads(run("replay", recording, "--json").stdout)
    assert (report["identical"], report["ticks"]) == (True, TICKS)
    result = run("replay", recording, "--resimulate")
    assert result.exit_code == 0, result.output


def test_a_file_that_has_changed_is_not_run(recording: Path, law_file: Path):
    law_file.write_text(marking_law(recording.parent).replace("was-run", "was-run-too"))
    for arguments in ((), ("--resimulate",)):
        result = run("replay", recording, *arguments)
        assert result.exit_code == 66
        assert "mine.py has changed since the run" in result.output
    assert not (recording.parent / "was-run-too").exists()


@pytest.mark.parametrize("of_folder", [True, False])
def test_a_file_that_others_may_write_is_not_run(recording: Path, law_file: Path, of_folder: bool):
    path = recording.parent if of_folder else law_file
    mode = path.stat().st_mode
    path.chmod(mode | 0o020)
    try:
        result = run("replay", recording)
    finally:
        path.chmod(mode)
    assert result.exit_code == 66
    assert "other users may write to this" in result.output
    assert not (recording.parent / "was-run").exists()


def test_a_recording_makes_no_script_run_that_is_no_law(tmp_path: Path):
    script = tmp_path / "script.py"
    script.write_text(f"import pathlib\npathlib.Path({str(tmp_path / 'was-run')!r}).write_text('run')\n")

    def name_script(header: dict) -> None:
        """Let the recorded law name the script and its digest."""
        law = next(law for law in header["law"]["laws"] if law["name"] == "mine")
        law |= {"file": str(script), "sha256": hashlib.sha256(script.read_bytes()).hexdigest()}

    result = run("replay", record_law(tmp_path, law_text(), name_script))
    assert result.exit_code == 66
    assert "script.py is not a law" in result.output
    assert not (tmp_path / "was-run").exists()


def test_the_recorded_text_is_identical_where_it_is_trusted(recording: Path):
    result = run("replay", recording, "--trust-recorded-law", "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert (report["identical"], report["ticks"]) == (True, TICKS)


def test_the_law_in_a_file_that_is_named(recording: Path, tmp_path: Path):
    (tmp_path / "law.py").write_text(marking_law(recording.parent))
    assert run("replay", recording, "--law", tmp_path / "law.py").exit_code == 0
    (tmp_path / "law.py").write_text(marking_law(recording.parent) + "# another\n")
    result = run("replay", recording, "--law", tmp_path / "law.py")
    assert result.exit_code == 66
    assert "no installed law equals the law that ran" in result.output


def change_text(header: dict) -> None:
    """Change a number in the recorded text of the law."""
    law = next(law for law in header["law"]["laws"] if law["name"] == "mine")
    law["text"] = law["text"].replace("100.0", "101.0")


def test_a_text_that_is_not_the_one_that_ran_is_refused(tmp_path: Path):
    path = record_law(tmp_path, law_text(), change_text)
    with pytest.raises(RecordingError, match="the law's text in the recording differs from the law that ran"):
        replay(rtloop.load(path), trust=TrustedLaws(recorded=True))


def test_a_text_that_does_not_define_the_named_law_is_refused(tmp_path: Path):
    def rename_law(header: dict) -> None:
        next(law for law in header["law"]["laws"] if law["name"] == "mine")["name"] = "other"

    path = record_law(tmp_path, law_text(), rename_law)
    with pytest.raises(RecordingError, match=r"run\.mcap: law 'other': .*run\.mcap: does not define the law 'other'"):
        replay(rtloop.load(path), trust=TrustedLaws(recorded=True))


def test_another_law_by_the_same_records_does_not_replay_as_it(tmp_path: Path):
    """A law with the same records but another text has another digest than the recording."""
    path = record_law(tmp_path, law_text())
    other_laws = laws_in(law_text().replace("100.0", "99.0"), "other.py")
    with pytest.raises(RecordingError, match="no installed law equals the law that ran"):
        replay(rtloop.load(path), trust=TrustedLaws(other_laws))
    assert replay(rtloop.load(path), trust=TrustedLaws(laws_in(law_text(), "x.py"))).identical


def test_a_loop_knows_the_laws_alone_that_it_has_loaded(tmp_path: Path):
    loaded = (LawReference("transfer"), LawReference("pid"))
    library = Library(tmp_path, loaded)
    assert library.find({"kind": "pid"}, "transfer").kind == "pid"
    (tmp_path / "evil.py").write_text(marking_law(tmp_path))
    with pytest.raises(ValueError, match="is not loaded in the running loop; loaded: transfer, pid"):
        library.find({"file": "evil.py"}, "transfer")
    assert not (tmp_path / "was-run").exists()


def test_records_are_made_of_whole_lines():
    law = laws_in(law_text(), "law.py")[0]
    from rtloop.laws.registry import law_layout

    records: LawRecords = law_layout([law]).laws[0]
    assert records.coefficients.itemsize % 64 == records.state.itemsize % 64 == 0
    assert np.dtype(records.state).names is not None

"""Laws, their numbers and modes changed while the loop runs: the drive does not jump, and a replay is identical."""

from __future__ import annotations

from pathlib import Path

import pytest

import rtloop
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.recording.capture.session import Options
from rtloop.recording.replay.laws import TrustedLaws
from rtloop.recording.replay.replay import replay
from tests.laws.changing import AT_CHANGE_V, CONTROLLERS, MORE, change_at_random, configuration, drive_steps
from tests.laws.failing import text as law_text

MINE = {"mine": '[axis.controller]\nfile = "mine.py"\n'}
CHANGES, SEED = 80, 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a user law in `mine.py`."""
    folder = tmp_path_factory.mktemp("live")
    (folder / "mine.py").write_text(law_text())
    return folder


def record_changes(folder: Path, sections: dict[str, str], path: Path) -> rtloop.Recording:
    """Return the recording of a run with random changes among these laws; a trip or a refusal fails the test."""
    files = {path: Options(min_free_bytes=0)}
    changes = change_at_random(folder, sections, files, seed=SEED, count=CHANGES, model=False)
    recording = rtloop.load(path)
    kinds = [event["kind"] for event in recording.events]
    assert not {"tripped", "refused"} & set(kinds)
    assert kinds.count("load_law") == changes.done["numbers"] + changes.done["law"]
    return recording


def test_any_law_follows_any_other(folder: Path, tmp_path: Path):
    """The demand continues from the drive in force, and its steps are not much larger than with C(z) alone."""
    one_law = drive_steps(record_changes(folder, {"transfer": CONTROLLERS["transfer"]}, tmp_path / "alone.mcap"))
    recording = record_changes(folder, CONTROLLERS | MINE, tmp_path / "together.mcap")
    all_laws = drive_steps(recording)
    assert all_laws.at_change_v <= AT_CHANGE_V
    assert all_laws.largest_v <= MORE * one_law.largest_v
    assert all_laws.limited == 0
    report = replay(recording, trust=TrustedLaws(recorded=True))
    assert report.identical
    assert report.ticks == len(recording) > 100 * CHANGES
    assert report.snapshots > CHANGES // 2


def test_two_laws_of_one_name_keep_apart(folder: Path):
    """The digest of the text is part of a law's identity."""
    text, loop_text = (folder / "mine.py").read_text(), configuration(MINE["mine"], ["mine.py"], model=False)
    first, second = (prepare(parse(loop_text, "x", folder, "x"), paced=False).plan for _ in "ab")
    assert first.laws == second.laws
    (folder / "mine.py").write_text(text + "# edited\n")
    try:
        edited = prepare(parse(loop_text, "x", folder, "x"), paced=False).plan
    finally:
        (folder / "mine.py").write_text(text)
    assert edited.laws != first.laws

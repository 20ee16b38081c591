"""Recordings with names that are not UTF-8 are listed escaped and served under the listed name."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote

import pytest

from rtloop.panel.recordings import process_runner as aside
from rtloop.panel.recordings.folder import RecordingFolder
from rtloop.panel.web.recordings import Recordings
from tests.panel.served import Served
from tests.recording.hand_made_loop import make_rows, write_recording

LATIN, SHOWN = b"caf\xe9.mcap", "caf\\xe9.mcap"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two recordings, of which one was named on a system with Latin-1."""
    path = write_recording(tmp_path / "run.mcap", make_rows(100))
    shutil.copy(path, os.fsdecode(os.fsencode(tmp_path) + b"/" + LATIN))
    shutil.copy(path, os.fsdecode(os.fsencode(tmp_path) + b"/" + LATIN + b".part"))
    return tmp_path


@pytest.fixture
def served(folder: Path) -> Iterator[Served]:
    """The routes of the recordings in a folder, of a service that does nothing else."""
    service: Any = SimpleNamespace(describe=lambda: SimpleNamespace(recordings=folder))
    served = Served(Recordings(service, lambda: 1).routes())
    yield served
    served.close()


def test_a_name_that_is_no_utf_8_hides_no_recording(served: Served, folder: Path):
    status, _, body = served.ask("/api/recordings")
    assert status == 200
    assert {one["file"]: one["ticks"] for one in json.loads(body)} == {
        "run.mcap": 100, SHOWN: 100, f"{SHOWN}.part": 100
    }  # fmt: skip
    data = (folder / "run.mcap").read_bytes()
    for name in (SHOWN, f"{SHOWN}.part"):
        status, headers, body = served.ask(f"/api/recordings/{quote(name)}")
        assert (status, body) == (200, data)
        assert quote(name) in headers["content-disposition"]
        status, _, body = served.ask(f"/api/recordings/{quote(name)}/sweep?signals=tick")
        assert (status, SHOWN.encode()[:3] in body) == (200, True)


def test_figures_of_a_name_that_is_not_utf_8_are_served(served: Served, monkeypatch: pytest.MonkeyPatch):
    async def said(command: list[str], *_: Any) -> dict[str, Any]:
        if os.fsencode(command[-2]).endswith(LATIN):
            return {"recording": command[-2]}
        raise aside.ProcessFailed(f"{command[-2]}: damaged")

    monkeypatch.setattr(aside, "_run_json", said)
    status, _, body = served.ask(f"/api/recordings/{quote(SHOWN)}/info")
    assert (status, os.fsencode(json.loads(body)["recording"]).endswith(LATIN)) == (200, True)
    status, _, body = served.ask(f"/api/recordings/{quote(SHOWN)}.part/info")
    assert (status, "damaged" in json.loads(body)["error"]) == (422, True)


def test_a_file_of_exactly_the_name_goes_before_an_escaped_one(folder: Path):
    shutil.copy(folder / "run.mcap", folder / SHOWN)
    assert RecordingFolder(folder).path(SHOWN) == folder / SHOWN
    (folder / SHOWN).unlink()
    assert os.fsencode(RecordingFolder(folder).path(SHOWN) or "").endswith(LATIN)
    assert RecordingFolder(folder).path("caf?.mcap") is None


def test_a_link_in_place_of_a_recording_is_not_served(served: Served, folder: Path, monkeypatch):
    """Somebody exchanges the file between the look into the folder and the opening."""
    secret = folder / "secret"
    secret.write_bytes(b"secret")
    (folder / "run.mcap").unlink()
    (folder / "run.mcap").symlink_to(secret)
    (folder / "run.mcap.part").symlink_to(secret)
    monkeypatch.setattr(RecordingFolder, "path", lambda self, name: self.folder / name)
    for name in ("run.mcap", "run.mcap.part"):
        status, _, body = served.ask(f"/api/recordings/{name}")
        assert (status, b"secret" in body) == (404, False)

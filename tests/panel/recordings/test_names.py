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

from rtloop.panel.recordings import process_runner
from rtloop.panel.recordings.folder import RecordingFolder
from rtloop.panel.web.recordings import Recordings
from tests.panel.route_server import RouteServer
from tests.recording.hand_made_loop import make_rows, write_recording

LATIN_NAME, LISTED_NAME = b"caf\xe9.mcap", "caf\\xe9.mcap"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with run.mcap and two copies with names in Latin-1, one of which ends in .part."""
    path = write_recording(tmp_path / "run.mcap", make_rows(100))
    shutil.copy(path, os.fsdecode(os.fsencode(tmp_path) + b"/" + LATIN_NAME))
    shutil.copy(path, os.fsdecode(os.fsencode(tmp_path) + b"/" + LATIN_NAME + b".part"))
    return tmp_path


@pytest.fixture
def server(folder: Path) -> Iterator[RouteServer]:
    """Yield a server of the recordings in the folder, without a service."""
    service: Any = SimpleNamespace(describe=lambda: SimpleNamespace(recordings=folder))
    server = RouteServer(Recordings(service, lambda: 1).routes())
    yield server
    server.close()


def test_a_name_that_is_no_utf_8_hides_no_recording(server: RouteServer, folder: Path):
    status, _, body = server.request("/api/recordings")
    assert status == 200
    assert {entry["file"]: entry["ticks"] for entry in json.loads(body)} == {
        "run.mcap": 100, LISTED_NAME: 100, f"{LISTED_NAME}.part": 100
    }  # fmt: skip
    data = (folder / "run.mcap").read_bytes()
    for name in (LISTED_NAME, f"{LISTED_NAME}.part"):
        status, headers, body = server.request(f"/api/recordings/{quote(name)}")
        assert (status, body) == (200, data)
        assert quote(name) in headers["content-disposition"]
        status, _, body = server.request(f"/api/recordings/{quote(name)}/sweep?signals=tick")
        assert (status, LISTED_NAME.encode()[:3] in body) == (200, True)


def test_figures_of_a_name_that_is_not_utf_8_are_served(server: RouteServer, monkeypatch: pytest.MonkeyPatch):
    async def run_json(command: list[str], *_: Any) -> dict[str, Any]:
        if os.fsencode(command[-2]).endswith(LATIN_NAME):
            return {"recording": command[-2]}
        raise process_runner.ProcessFailed(f"{command[-2]}: damaged")

    monkeypatch.setattr(process_runner, "_run_json", run_json)
    status, _, body = server.request(f"/api/recordings/{quote(LISTED_NAME)}/info")
    assert (status, os.fsencode(json.loads(body)["recording"]).endswith(LATIN_NAME)) == (200, True)
    status, _, body = server.request(f"/api/recordings/{quote(LISTED_NAME)}.part/info")
    assert (status, "damaged" in json.loads(body)["error"]) == (422, True)


def test_a_file_of_exactly_the_name_goes_before_an_escaped_one(folder: Path):
    shutil.copy(folder / "run.mcap", folder / LISTED_NAME)
    assert RecordingFolder(folder).path(LISTED_NAME) == folder / LISTED_NAME
    (folder / LISTED_NAME).unlink()
    assert os.fsencode(RecordingFolder(folder).path(LISTED_NAME) or "").endswith(LATIN_NAME)
    assert RecordingFolder(folder).path("caf?.mcap") is None


def test_a_link_in_place_of_a_recording_is_not_served(server: RouteServer, folder: Path, monkeypatch):
    """A link replaces the file after the folder was listed and before the file is opened."""
    secret = folder / "secret"
    secret.write_bytes(b"secret")
    (folder / "run.mcap").unlink()
    (folder / "run.mcap").symlink_to(secret)
    (folder / "run.mcap.part").symlink_to(secret)
    monkeypatch.setattr(RecordingFolder, "path", lambda self, name: self.folder / name)
    for name in ("run.mcap", "run.mcap.part"):
        status, _, body = server.request(f"/api/recordings/{name}")
        assert (status, b"secret" in body) == (404, False)

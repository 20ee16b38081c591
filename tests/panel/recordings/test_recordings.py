"""The panel serves recordings: listing, files and ranges, figures, pictures, sweeps, captures, and no other file."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rtloop
from rtloop.panel.recordings.process_runner import ProcessFailed, ProcessRunner, TooManyRequests
from rtloop.panel.service.service import Service
from rtloop.panel.web.recordings import Recordings
from rtloop.recording.replay.replay import replay
from tests.faults.bench import Bench
from tests.panel.served import Answer, Served
from tests.panel.web.browser import unpacked

RUN = 3


class Panel:
    """The routes of a bench's service at a separate port."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self.folder = bench, bench.folder / "recordings"
        served = Served(Recordings(Service(bench.client.path), lambda: RUN).routes())
        self.ask, self.close = served.ask, served.close

    def capture(self, **body: Any) -> Answer:
        return self.ask("/api/capture", "POST", body)


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panel]:
    with Bench(tmp_path_factory.mktemp("panel")) as bench:
        bench.await_drive()
        panel = Panel(bench)
        yield panel
        panel.close()


@pytest.fixture(scope="module")
def captured(panel: Panel) -> dict[str, Any]:
    """Half a second that was captured, and half of what comes."""
    tick = panel.bench.ticks
    answer = panel.capture(run=RUN, first=tick - 1000, end=tick + 1000)
    assert answer.code == 200, answer.body
    return answer.json


def test_a_capture_replays_and_is_in_the_list(panel: Panel, captured: dict[str, Any]):
    assert (captured["replay"], captured["gaps"], captured["problems"]) == ("identical", [], [])
    recording = rtloop.load(panel.folder / captured["file"])
    assert replay(recording).identical
    assert len(recording) == captured["ticks"] >= 2000
    growing, there = panel.ask("/api/recordings").json, {one["file"]: one for one in panel.ask("/api/recordings").json}
    assert len(growing) == len(there) == 2
    one = there[captured["file"]]
    assert (one["captured"], one["complete"], one["ticks"], one["trips"]) == (True, True, captured["ticks"], 0)
    assert one["bytes"] == (panel.folder / captured["file"]).stat().st_size
    assert one["duration_s"] == pytest.approx(captured["ticks"] / 4000, rel=0.05)
    assert one["cut"]["first"] == captured["first"]
    assert one["begins_unix_s"] == pytest.approx(one["created_unix_s"] + recording["deadline_ns"][0] / 1e9, abs=1e-3)
    (run,) = (one for one in there.values() if one["file"].endswith(".part"))
    assert (run["captured"], run["complete"], run["cut"]) == (False, False, None)


def test_the_last_seconds_are_captured(panel: Panel):
    before = panel.bench.ticks
    said = panel.capture(seconds=0.25).json
    assert (said["end"] - said["first"], said["replay"]) == (1000, "identical")
    assert said["end"] >= before - 50
    os.unlink(panel.folder / said["file"])


@pytest.mark.parametrize(
    ("body", "code", "words"),
    [
        ({"run": RUN - 1, "first": 0, "end": 5}, 410, "was started again"),
        ({"first": 5, "end": 5}, 422, "end: 5; allowed: above 5, the value of `first`"),
        ({"first": 0}, 422, "allowed: either `seconds` alone, or `first` with `end`"),
        ({"seconds": 1.0, "first": 0, "end": 4}, 422, "ticks to capture: not clear; allowed: either `seconds` alone"),
        ({"seconds": 0.25, "first": 0}, 422, "ticks to capture: not clear; allowed: either `seconds` alone"),
        ({"seconds": 0.25, "end": 4}, 422, "ticks to capture: not clear; allowed: either `seconds` alone"),
        ({"seconds": 1e9}, 422, "seconds"),
        ({"seconds": "1"}, 422, "seconds"),
        ({"first": 0, "end": 10**9}, 422, "at most 600 s"),
        ({"first": 10**9, "end": 10**9 + 5}, 422, "allowed: at most 60 s after the newest tick"),
        ({"first": 0, "end": 5, "file": "/etc/passwd"}, 422, "file"),
        (b"{", 422, ""),
        (b"\xff" * 10, 422, ""),
        (b" " * 5000, 413, "allowed: at most 4096 bytes"),
    ],
)
def test_invalid_captures_are_refused(panel: Panel, body: Any, code: int, words: str):
    before = os.listdir(panel.folder)
    answer = panel.ask("/api/capture", "POST", body)
    assert (answer.code, words in answer.json["error"]) == (code, True), answer.body
    assert os.listdir(panel.folder) == before


def test_files_and_ranges_of_them_can_be_downloaded(panel: Panel, captured: dict[str, Any]):
    name, data = captured["file"], (panel.folder / captured["file"]).read_bytes()
    path = f"/api/recordings/{name}"
    answer = panel.ask(path)
    assert (answer.code, answer.body) == (200, data)
    assert answer.headers["content-disposition"] == f'attachment; filename="{name}"'
    part = panel.ask(path, Range="bytes=100-299")
    assert (part.code, part.body, part.headers["content-range"]) == (206, data[100:300], f"bytes 100-299/{len(data)}")
    assert panel.ask(path, Range=f"bytes={len(data)}-").code == 416
    (growing,) = panel.folder.glob("*.part")
    found = panel.ask(f"/api/recordings/{growing.name}")
    assert found.code == 200
    assert len(found.body) == int(found.headers["content-length"])
    assert growing.read_bytes().startswith(found.body)


def test_files_that_are_no_recordings_are_not_served(panel: Panel, tmp_path: Path):
    secret = tmp_path / "secret.mcap"
    secret.write_bytes(b"secret")
    (panel.folder / "notes.txt").write_bytes(b"secret")
    (panel.folder / ".hidden").write_bytes(b"secret")
    (panel.folder / "folder.mcap").mkdir()
    os.symlink(secret, panel.folder / "link.mcap")
    os.symlink("/", panel.folder / "root.mcap")
    os.mkfifo(panel.folder / "pipe.mcap")
    config = panel.bench.config.name
    names = ["link.mcap", "root.mcap", "pipe.mcap", "folder.mcap", "notes.txt", ".hidden", "nothing.mcap", "..",
             "%2e%2e", f"..%2f{config}", f"%2e%2e%2f{config}", f"../{config}", f"..%5c{config}", "%2fetc%2fpasswd",
             "link.mcap%00",
             "root.mcap/etc/passwd", "%00", "a" * 5000, "*.mcap", "%ff%fe.mcap", "--out=x.mcap"]  # fmt: skip
    for name in names:
        for behind in ("", "/info", "/plot.png", "/sweep?signals=tick"):
            answer = panel.ask(f"/api/recordings/{name}{behind}")
            assert answer.code in (404, 400), (name, behind, answer)
            assert b"secret" not in answer.body
            assert b"[loop]" not in answer.body
    listed = {one["file"] for one in panel.ask("/api/recordings").json}
    assert not {"link.mcap", "root.mcap", "pipe.mcap", "folder.mcap", "notes.txt"} & listed
    for left in ("link.mcap", "root.mcap", "pipe.mcap", "notes.txt", ".hidden"):
        os.unlink(panel.folder / left)
    os.rmdir(panel.folder / "folder.mcap")


def test_figures_and_pictures_of_a_recording_are_served(panel: Panel, captured: dict[str, Any]):
    path = f"/api/recordings/{captured['file']}"
    info = panel.ask(f"{path}/info").json
    assert (info["ticks_logged"], info["complete"], info["cut"]["end"]) == (captured["ticks"], True, captured["end"])
    picture = panel.ask(f"{path}/plot.png")
    assert (picture.code, picture.headers["content-type"], picture.body[:8]) == (200, "image/png", b"\x89PNG\r\n\x1a\n")
    for wrong in ("from=nan", "from=-1", "until=0", "out=x", "from=1&until=x"):
        assert panel.ask(f"{path}/plot.png?{wrong}").code == 422
    (panel.folder / "junk.mcap").write_bytes(b"junk")
    for what in ("info", "sweep?signals=tick"):
        said = panel.ask(f"/api/recordings/junk.mcap/{what}")
        assert (said.code, "not a recording" in said.json["error"]) == (422, True)
    assert [one["ticks"] for one in panel.ask("/api/recordings").json if one["file"] == "junk.mcap"] == [None]
    os.unlink(panel.folder / "junk.mcap")


def test_sweeps_of_a_recording_have_its_samples(panel: Panel, captured: dict[str, Any]):
    recording, path = rtloop.load(panel.folder / captured["file"]), f"/api/recordings/{captured['file']}/sweep"
    signal = recording["x_position_um"][(recording["tick"] >= captured["first"])]
    header, arrays = unpacked(panel.ask(f"{path}?signals=x_position_um,tick&pixels=4000").body)
    assert (header["first"], header["end"], header["signals"]) == (
        captured["first"],
        captured["end"],
        ["x_position_um", "tick"],
    )
    assert arrays["offset"].tolist() == list(range(2000))
    for bound in ("low", "high"):
        assert np.array_equal(arrays[f"x_position_um:{bound}"], signal.astype("<f4"))
    first = captured["first"] + 100
    header, arrays = unpacked(
        panel.ask(f"{path}?signals=x_position_um&first={first}&ticks=1000&pixels=100&trigger={first + 500}").body
    )
    assert (header["first"], header["end"], header["trigger"]) == (first, first + 1000, first + 500)
    assert arrays["offset"].tolist() == list(range(-500, 500, 10))
    shown = signal[100:1100].astype("<f4").reshape(100, 10)
    assert np.array_equal(arrays["x_position_um:low"], shown.min(axis=1))
    assert np.array_equal(arrays["x_position_um:high"], shown.max(axis=1))
    nine, behind = ",".join(["tick"] * 9), f"signals=tick&first={captured['end']}&ticks=1"
    for wrong in ("signals=nothing", "signals=", "", "signals=tick&pixels=0", "signals=tick&pixels=1e9", behind,
                  "signals=tick&first=-1", "signals=tick&ticks=100000000",
                  f"signals={nine}", "signals=tick&more=1"):  # fmt: skip
        answer = panel.ask(f"{path}?{wrong}")
        assert (answer.code, bool(answer.json["error"])) == (422, True), wrong


def test_processes_beyond_the_limit_are_refused():
    async def many() -> list[Any]:
        runner = ProcessRunner(max_unfinished=2)
        requests = [runner.run("rtloop.nowhere") for _ in range(5)]
        return await asyncio.gather(*requests, return_exceptions=True)

    results = [type(result) for result in asyncio.run(many())]
    assert (results.count(TooManyRequests), results.count(ProcessFailed)) == (3, 2)


def test_a_command_that_fails_is_named_as_somebody_types_it():
    async def failure(runner: ProcessRunner, module: str, *arguments: str) -> str:
        with pytest.raises(ProcessFailed) as caught:
            await runner.run(module, *arguments)
        return str(caught.value)

    said = asyncio.run(failure(ProcessRunner(), "rtloop", "--help"))
    assert said.startswith("`rtloop --help` ended with exit code 0 and without a result; run it in a terminal")
    said = asyncio.run(failure(ProcessRunner(timeout_s=0.01), "rtloop.nowhere", "my run.mcap"))
    assert said.startswith("`python -m rtloop.nowhere 'my run.mcap'` did not finish within 0.01 s; run it")


def test_recordings_are_served_without_the_service(panel: Panel, captured: dict[str, Any]):
    """Last in this file: the service ends. What it recorded stays."""
    panel.bench.stop()
    listed = {one["file"]: one for one in panel.ask("/api/recordings").json}
    assert captured["file"] in listed
    assert [one["complete"] for one in listed.values()] == [True, True]
    answer = panel.capture(seconds=1.0)
    assert (answer.code, "no service answers" in answer.json["error"]) == (503, True)

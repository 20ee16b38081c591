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
from tests.panel.route_server import Response, RouteServer
from tests.panel.web.browser import unpack_message

pytestmark = pytest.mark.system

RUN = 3
"""Number of the run that the panel shows."""


class Panel:
    """Server of the recordings in `folder` and of captures for the service of a bench."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self.folder = bench, bench.folder / "recordings"
        server = RouteServer(Recordings(Service(bench.client.path), lambda: RUN).routes())
        self.request, self.close = server.request, server.close

    def capture(self, **body: Any) -> Response:
        return self.request("/api/capture", "POST", body)


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panel]:
    """Yield the panel of a running loop."""
    with Bench(tmp_path_factory.mktemp("panel")) as bench:
        bench.await_drive()
        panel = Panel(bench)
        yield panel
        panel.close()


@pytest.fixture(scope="module")
def capture(panel: Panel) -> dict[str, Any]:
    """Return the report of a capture of 2000 ticks, of which half are in the future when it is requested."""
    tick = panel.bench.ticks
    response = panel.capture(run=RUN, first=tick - 1000, end=tick + 1000)
    assert response.code == 200, response.body
    return response.json


def test_a_capture_replays_and_is_in_the_list(panel: Panel, capture: dict[str, Any]):
    assert (capture["replay"], capture["gaps"], capture["problems"]) == ("identical", [], [])
    recording = rtloop.load(panel.folder / capture["file"])
    assert replay(recording).identical
    assert len(recording) == capture["ticks"] >= 2000
    entries = panel.request("/api/recordings").json
    by_file = {entry["file"]: entry for entry in panel.request("/api/recordings").json}
    assert len(entries) == len(by_file) == 2
    entry = by_file[capture["file"]]
    assert (entry["captured"], entry["complete"], entry["ticks"], entry["trips"]) == (True, True, capture["ticks"], 0)
    assert entry["bytes"] == (panel.folder / capture["file"]).stat().st_size
    assert entry["duration_s"] == pytest.approx(capture["ticks"] / 4000, rel=0.05)
    assert entry["cut"]["first"] == capture["first"]
    assert entry["begins_unix_s"] == pytest.approx(
        entry["created_unix_s"] + recording["deadline_ns"][0] / 1e9, abs=1e-3
    )
    (run,) = (entry for entry in by_file.values() if entry["file"].endswith(".part"))
    assert (run["captured"], run["complete"], run["cut"]) == (False, False, None)


def test_the_last_seconds_are_captured(panel: Panel):
    before = panel.bench.ticks
    report = panel.capture(seconds=0.25).json
    assert (report["end"] - report["first"], report["replay"]) == (1000, "identical")
    assert report["end"] >= before - 50
    os.unlink(panel.folder / report["file"])


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
    response = panel.request("/api/capture", "POST", body)
    assert (response.code, words in response.json["error"]) == (code, True), response.body
    assert os.listdir(panel.folder) == before


def test_files_and_ranges_of_them_can_be_downloaded(panel: Panel, capture: dict[str, Any]):
    name, data = capture["file"], (panel.folder / capture["file"]).read_bytes()
    path = f"/api/recordings/{name}"
    response = panel.request(path)
    assert (response.code, response.body) == (200, data)
    assert response.headers["content-disposition"] == f'attachment; filename="{name}"'
    part = panel.request(path, Range="bytes=100-299")
    assert (part.code, part.body, part.headers["content-range"]) == (206, data[100:300], f"bytes 100-299/{len(data)}")
    assert panel.request(path, Range=f"bytes={len(data)}-").code == 416
    (growing,) = panel.folder.glob("*.part")
    partial = panel.request(f"/api/recordings/{growing.name}")
    assert partial.code == 200
    assert len(partial.body) == int(partial.headers["content-length"])
    assert growing.read_bytes().startswith(partial.body)


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
        for suffix in ("", "/info", "/plot.png", "/sweep?signals=tick"):
            response = panel.request(f"/api/recordings/{name}{suffix}")
            assert response.code in (404, 400), (name, suffix, response)
            assert b"secret" not in response.body
            assert b"[loop]" not in response.body
    listed = {entry["file"] for entry in panel.request("/api/recordings").json}
    assert not {"link.mcap", "root.mcap", "pipe.mcap", "folder.mcap", "notes.txt"} & listed
    for created in ("link.mcap", "root.mcap", "pipe.mcap", "notes.txt", ".hidden"):
        os.unlink(panel.folder / created)
    os.rmdir(panel.folder / "folder.mcap")


def test_figures_and_pictures_of_a_recording_are_served(panel: Panel, capture: dict[str, Any]):
    path = f"/api/recordings/{capture['file']}"
    info = panel.request(f"{path}/info").json
    assert (info["ticks_logged"], info["complete"], info["cut"]["end"]) == (capture["ticks"], True, capture["end"])
    picture = panel.request(f"{path}/plot.png")
    assert (picture.code, picture.headers["content-type"], picture.body[:8]) == (200, "image/png", b"\x89PNG\r\n\x1a\n")
    for invalid in ("from=nan", "from=-1", "until=0", "out=x", "from=1&until=x"):
        assert panel.request(f"{path}/plot.png?{invalid}").code == 422
    (panel.folder / "junk.mcap").write_bytes(b"junk")
    for resource in ("info", "sweep?signals=tick"):
        refusal = panel.request(f"/api/recordings/junk.mcap/{resource}")
        assert (refusal.code, "not a recording" in refusal.json["error"]) == (422, True)
    entries = panel.request("/api/recordings").json
    assert [entry["ticks"] for entry in entries if entry["file"] == "junk.mcap"] == [None]
    os.unlink(panel.folder / "junk.mcap")


def test_sweeps_of_a_recording_have_its_samples(panel: Panel, capture: dict[str, Any]):
    recording, path = rtloop.load(panel.folder / capture["file"]), f"/api/recordings/{capture['file']}/sweep"
    signal = recording["x_position_um"][(recording["tick"] >= capture["first"])]
    header, arrays = unpack_message(panel.request(f"{path}?signals=x_position_um,tick&pixels=4000").body)
    assert (header["first"], header["end"], header["signals"]) == (
        capture["first"],
        capture["end"],
        ["x_position_um", "tick"],
    )
    assert arrays["offset"].tolist() == list(range(2000))
    for bound in ("low", "high"):
        assert np.array_equal(arrays[f"x_position_um:{bound}"], signal.astype("<f4"))
    first = capture["first"] + 100
    header, arrays = unpack_message(
        panel.request(f"{path}?signals=x_position_um&first={first}&ticks=1000&pixels=100&trigger={first + 500}").body
    )
    assert (header["first"], header["end"], header["trigger"]) == (first, first + 1000, first + 500)
    assert arrays["offset"].tolist() == list(range(-500, 500, 10))
    pixels = signal[100:1100].astype("<f4").reshape(100, 10)
    assert np.array_equal(arrays["x_position_um:low"], pixels.min(axis=1))
    assert np.array_equal(arrays["x_position_um:high"], pixels.max(axis=1))
    nine_signals, after_end = ",".join(["tick"] * 9), f"signals=tick&first={capture['end']}&ticks=1"
    for invalid in ("signals=nothing", "signals=", "", "signals=tick&pixels=0", "signals=tick&pixels=1e9", after_end,
                  "signals=tick&first=-1", "signals=tick&ticks=100000000",
                  f"signals={nine_signals}", "signals=tick&more=1"):  # fmt: skip
        response = panel.request(f"{path}?{invalid}")
        assert (response.code, bool(response.json["error"])) == (422, True), invalid


def test_processes_beyond_the_limit_are_refused():
    async def run_five() -> list[Any]:
        """Return the outcomes of five requests at once to a runner with a limit of two."""
        runner = ProcessRunner(max_unfinished=2)
        requests = [runner.run("rtloop.nowhere") for _ in range(5)]
        return await asyncio.gather(*requests, return_exceptions=True)

    results = [type(result) for result in asyncio.run(run_five())]
    assert (results.count(TooManyRequests), results.count(ProcessFailed)) == (3, 2)


def test_a_process_whose_request_is_cancelled_is_killed():
    """A process that is not killed would be waited for without end."""

    async def run_and_cancel() -> None:
        request = asyncio.create_task(ProcessRunner().run("http.server", "0", "--bind", "127.0.0.1"))
        await asyncio.sleep(0.2)
        request.cancel()
        with pytest.raises(asyncio.CancelledError):
            await request

    asyncio.run(run_and_cancel())
    with pytest.raises(ValueError, match="null byte"):
        asyncio.run(ProcessRunner().run("rtloop", "\0"))


def test_a_command_that_fails_is_named_as_somebody_types_it():
    async def failure_text(runner: ProcessRunner, module: str, *arguments: str) -> str:
        """Return the message of the error with which a command fails."""
        with pytest.raises(ProcessFailed) as caught:
            await runner.run(module, *arguments)
        return str(caught.value)

    message = asyncio.run(failure_text(ProcessRunner(), "rtloop", "--help"))
    assert message.startswith("`rtloop --help` ended with exit code 0 and without a result; run it in a terminal")
    message = asyncio.run(failure_text(ProcessRunner(timeout_s=0.01), "rtloop.nowhere", "my run.mcap"))
    assert message.startswith("`python -m rtloop.nowhere 'my run.mcap'` did not finish within 0.01 s; run it")


def test_recordings_are_served_without_the_service(panel: Panel, capture: dict[str, Any]):
    """This test is the last of the file, for it stops the service."""
    panel.bench.stop()
    by_file = {entry["file"]: entry for entry in panel.request("/api/recordings").json}
    assert capture["file"] in by_file
    assert [entry["complete"] for entry in by_file.values()] == [True, True]
    response = panel.capture(seconds=1.0)
    assert (response.code, "no service answers" in response.json["error"]) == (503, True)

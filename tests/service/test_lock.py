"""The lock of a service: one client drives, every client may read and stop, and the events have the client's name."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

import pytest
from click.testing import CliRunner

import rtloop
from rtloop.cli import main
from rtloop.client import Client
from rtloop.errors import RtloopError
from tests.faults.configuration import on_a_rig
from tests.virtual.bench import VirtualBench

KEY = "brass-otter-seven"
DIGEST = hashlib.sha256(KEY.encode()).hexdigest()
TUNE = {"axis": "x", "section": "limits", "values": {"bump_s": 0.02}}
ADA_HOLDS_LOCK = "ada has held the lock since "
REQUESTS: dict[str, Any] = {
    "/arm": {}, "/start": {}, "/reset": {}, "/reload": {}, "/mode": {"mode": "raw"}, "/tune": TUNE,
    "/setpoint": {"axis": "x", "value": 1.0}, "/reference": {"axis": "x", "reference": {"kind": "hold", "value": 1.0}},
    "/waveform": {"axis": "x", "samples": [1.0]}, "/response": {"axis": "x"},
    "/learn": {"axis": "x", "samples": [0.0] * 4}, "/controller": {"axis": "x", "controller": {}},
}  # fmt: skip
INVALID_NAMES = ["", " ada", "ada ", "a\nb", "\x1b[2Jada", "a\0b", "\u202eada", "[red]", "<b>", "a/b", "é" * 41,
                 "can", "LOOP", "recorder", "Operator", "42", "-rf", "\ufffd"]  # fmt: skip

VALID_NAMES = ["ada", "Ada Lovelace", "李小龍", "Zoë Ångström", "x.y-z_1", "a@b+c", "O'Neill"]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualBench]:
    """Yield a service on the simulated rig, armed on command, with an emergency key."""
    section = f'[service]\narm = true\nemergency_key_sha256 = "{DIGEST}"\n[recording]'
    folder = tmp_path_factory.mktemp("lock")
    with pytest.MonkeyPatch.context() as patch:
        bench = VirtualBench(folder, patch, on_a_rig(folder, ("[recording]", section)))
        bench.await_state("stopped")
        yield bench
        bench.end()


@pytest.fixture
def ada(bench: VirtualBench) -> Iterator[Client]:
    """Yield a client that holds the lock and drives in closed loop; stop the loop and release the lock afterwards."""
    client = Client(bench.client.path, "ada")
    client.post("/arm")
    client.post("/setpoint", {"axis": "x", "value": 20.0})
    client.post("/start")
    bench.await_drive()
    yield client
    client.lock(KEY)
    client.post("/stop")
    client.delete("/lock")
    bench.await_state("stopped")


@pytest.fixture
def bob(bench: VirtualBench) -> Client:
    """Return a second client."""
    return Client(bench.client.path, "bob")


def test_the_second_is_refused_with_who_drives_and_both_may_stop(bench: VirtualBench, ada: Client, bob: Client):
    lock = bench.status()["lock"]
    assert lock["name"] == "ada"
    assert 0 < lock["until_unix_s"] - lock["since_unix_s"] < 120
    ada.post("/setpoint", {"axis": "x", "value": 7.0})
    for path, body in REQUESTS.items():
        for query in ("?as=bob", ""):
            code, response = bench.answer("POST", f"{path}{query}", body)
            assert (code, response["error"][: len(ADA_HOLDS_LOCK)]) == (409, ADA_HOLDS_LOCK), path
    assert "rtloop_state" in bob.get("/metrics")
    assert (bench.status()["axes"]["x"]["reference_um"], bench.status()["mode"]) == (7.0, "closed_loop")
    stopped = bob.post("/stop")["tick"]
    assert bench.status()["lock"]["name"] == "ada"
    bench.await_state("stopped")
    ada.post("/arm")
    started, off = ada.post("/start")["tick"], bob.post("/mode", {"mode": "off"})["tick"]
    end = ada.post("/stop")["tick"]
    for tick, who in ((stopped, "bob"), (started, "ada"), (off, "bob"), (end, "ada")):
        bench.event("set_mode", tick, who)


def test_what_was_changed_is_recorded_under_the_name(bench: VirtualBench, ada: Client):
    changed, loaded = ada.post("/setpoint", REQUESTS["/setpoint"])["tick"], ada.post("/tune", TUNE)["tick"]
    bench.event("set_reference", changed, "ada")
    bench.event("load_law", loaded, "ada")
    ada.delete("/lock")
    unnamed = bench.client.post("/setpoint", REQUESTS["/setpoint"])["tick"]
    bench.event("set_reference", unnamed)
    assert bench.status()["lock"]["name"] == "operator"
    bench.client.post("/setpoint", REQUESTS["/setpoint"])  # clients without a name count as one
    with pytest.raises(RtloopError, match=r"^operator \(a client without a name\) has held the lock since "):
        ada.post("/setpoint", REQUESTS["/setpoint"])


def test_only_the_emergency_key_breaks_it(bench: VirtualBench, ada: Client, bob: Client):
    for key in ("", "brass-otter-six", DIGEST, "ä\0"):
        with pytest.raises(RtloopError, match=r"^the given emergency key is wrong; "):
            bob.lock(key)
    for request in (bob.lock, lambda: bob.delete("/lock")):
        with pytest.raises(RtloopError, match=f"^{ADA_HOLDS_LOCK}.*; `rtloop ctl stop` works without the lock$"):
            request()
    assert bench.status()["lock"]["name"] == "ada"
    assert bob.lock(KEY)["name"] == "bob"
    with pytest.raises(RtloopError, match=r"^bob has held the lock since "):
        ada.post("/setpoint", REQUESTS["/setpoint"])
    assert bob.delete("/lock") == {}
    assert bench.status()["lock"] is None
    assert KEY not in json.dumps(bench.client.get("/configuration"))


def test_what_is_no_name_is_refused_but_stops(bench: VirtualBench):
    stopped: dict[str, int] = {}
    for name in INVALID_NAMES:
        before = bench.status()["lock"]
        query = f"?as={quote(name, safe='')}"
        for path in ("/arm", "/lock"):
            code, response = bench.answer("POST", f"{path}{query}")
            refused = (code, response["error"][:4], response["error"].replace("…", "").isascii())
            assert refused == (422, "as: ", True), name
        assert bench.status()["lock"] == before, name
        stopped[name] = bench.answer("POST", f"/stop{query}")[1]["tick"]
    for tick in stopped.values():
        bench.event("set_mode", tick)


@pytest.mark.parametrize("query", ["as=%ff", "as=a&as=b", "as=%", "as=" + 60_000 * "a"])
def test_a_query_that_is_none(bench: VirtualBench, query: str):
    code, _, response = bench.client.exchange("POST", f"/arm?{query}", "")
    assert code == 422
    assert len(response) < 300
    assert bench.status()["state"] == "stopped"


def test_names_of_people(bench: VirtualBench):
    stopped: dict[str, int] = {}
    for name in VALID_NAMES:
        with rtloop.connect(bench.client.path, as_=name) as loop:
            stopped[name] = loop.stop()
            loop.arm()
            assert loop.status["lock"]["name"] == name
            loop.stop()
        assert bench.status()["lock"] is None, name
    for name, tick in stopped.items():
        bench.event("set_mode", tick, name)


def test_ctl_drives_under_a_name(bench: VirtualBench, ada: Client):
    def ctl(*arguments: str, typed: str | None = None) -> Any:
        result = CliRunner().invoke(main, ["ctl", "--socket", str(bench.client.path), "--as", *arguments], input=typed)
        return result.exit_code, result.output

    code, output = ctl("bob", "setpoint", "x", "3")
    assert (code, output[:28]) == (1, f"rtloop: {ADA_HOLDS_LOCK}"[:28])
    assert ctl("bob", "lock")[0] == ctl("bob", "release")[0] == ctl("bob", "lock", "--break", typed="no\n")[0] == 1
    assert ctl("bob", "lock", "--break", typed=f"{KEY}\n")[0] == 0
    code, output = ctl("bob", "setpoint", "x", "3")
    bench.event("set_reference", json.loads(output)["tick"], "bob")
    assert json.loads(ctl("eve", "status")[1])["lock"]["name"] == "bob"
    assert ctl("bob", "release") == (0, "{}\n")
    assert ctl("a\x1bb", "arm") == (1, "rtloop: as: 'a\\x1bb'; allowed: 1 to 40 letters, digits, blanks and .-_@+', a "
                                       "letter or digit first, no blank last\n")  # fmt: skip


def test_connect(bench: VirtualBench, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rtloop.supervision.paths.client_folders", lambda: [bench.client.path.parent])
    bench.client.path.touch()  # a service is found by the name of its socket
    with rtloop.connect("lab", as_="ada") as loop, rtloop.connect(str(bench.client.path), as_="bob") as bob:
        loop.arm()
        loop.setpoint("x", 20.0)
        start_tick = loop.start()
        bench.await_drive()
        assert loop.setpoint("x", 12.5) > start_tick
        assert loop.status["axes"]["x"]["reference_um"] == 12.5
        reference_tick = loop.reference("x", kind="sine", amplitude=2.0, frequency_hz=3.0)
        tune_tick = loop.tune("x", "controller", gain=0.012)
        bench.event("set_reference", reference_tick, "ada")
        bench.event("load_law", tune_tick, "ada")
        for request in (bob.start, bob.reset, bob.take, bob.release, lambda: bob.setpoint("x", 1.0)):
            with pytest.raises(RtloopError, match=f"^{ADA_HOLDS_LOCK}"):
                request()
        for value, message in ((99.0, "a magnitude of 99 µm"), (float("nan"), "value: "), ("5", "value: ")):
            with pytest.raises(RtloopError, match=message):
                loop.setpoint("x", value)  # type: ignore[arg-type]
        with pytest.raises(RtloopError, match="there is no trip"):
            loop.reset()
        bob.stop()
        assert bob.take(emergency_key=KEY)["name"] == "bob"
    assert rtloop.connect().status["lock"] is None
    bench.await_state("stopped")

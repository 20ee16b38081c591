"""The lock with a clock that the test moves: idle time, long work, and an emergency key during the work."""

from __future__ import annotations

import asyncio
import hashlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rtloop.configuration.file import load
from rtloop.engine.messages import Kind, Origin, message
from rtloop.errors import ConfigError
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.file.topics.events import OPERATOR, event_from_message, message_from_event, name_problem
from rtloop.service.api.application import application
from rtloop.service.desk import Desk, Refusal
from rtloop.service.lock import Lock
from tests.faults.configuration import on_a_board

DIGEST = hashlib.sha256(b"a key").hexdigest()


class Clock:
    """Clock (s) that the test moves."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class Bench:
    """The API of a service without a loop: `arm` takes `work_s` and then calls `meanwhile`."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.lock = Lock(self.clock)
        self.work_s, self.meanwhile = 0.0, lambda: None
        options = SimpleNamespace(service=SimpleNamespace(emergency_key_sha256=DIGEST), axes=[])
        service: Any = SimpleNamespace(
            lock=self.lock, configuration=options, arm=self._arm, stop=lambda: 7, is_ending=False
        )
        self._application = application(service)

    def _arm(self) -> None:
        self.clock.now_s += self.work_s
        self.meanwhile()

    def request(self, name: str, path: str = "/arm", method: str = "POST") -> tuple[int, str]:
        """Send a request as the client `name`; return the status and the error message, or an empty text."""
        scope = {"type": "http", "method": method, "path": path, "query_string": f"as={name}".encode(), "headers": []}
        sent: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: dict[str, Any]) -> None:
            sent.append(message)

        asyncio.run(self._application(scope, receive, send))  # type: ignore[arg-type]
        return sent[0]["status"], json.loads(sent[1]["body"]).get("error", "")


def test_after_a_minute_of_silence_another_drives():
    bench = Bench()
    assert bench.request("ada")[0] == 200
    bench.clock.now_s += 59.0
    code, error = bench.request("bob")
    assert (code, "becomes free after 1 s without a command" in error) == (409, True)
    assert bench.request("ada") == (200, "")  # a command restarts the minute
    bench.clock.now_s += 59.9
    assert [bench.request("bob", path)[0] for path in ("/arm", "/lock", "/stop")] == [409, 409, 200]
    bench.clock.now_s += 0.1
    assert bench.lock.holder is None
    assert bench.request("bob")[0] == 200
    assert bench.request("ada")[1].startswith("bob has held the lock since ")


def test_stop_and_what_reads_takes_no_lock():
    bench = Bench()
    assert [bench.request("bob", "/stop")[0], bench.request("bob", "/openapi.json", "GET")[0]] == [200, 200]
    assert bench.lock.holder is None
    assert bench.request("ada", "/lock")[0] == 200
    bench.clock.now_s += 30.0
    bench.request("bob", "/stop")
    bench.clock.now_s += 30.0
    assert bench.request("bob")[0] == 200


def test_work_that_goes_on_is_no_silence():
    bench = Bench()
    answers: list[tuple[int, str]] = []
    bench.work_s, bench.meanwhile = 300.0, lambda: answers.append(bench.request("bob", "/lock"))
    assert bench.request("ada")[0] == 200
    assert answers[0][0] == 409
    bench.clock.now_s += 59.0
    assert bench.request("bob", "/lock")[0] == 409
    bench.clock.now_s += 1.0
    assert bench.request("bob", "/lock")[0] == 200


def test_the_last_of_several_requests_begins_the_silence():
    clock = Clock()
    lock = Lock(clock)
    with lock.hold("ada"):
        with lock.hold("ada"):
            pass
        clock.now_s += 300.0
        with pytest.raises(Refusal, match=r"^ada has held the lock since "):
            lock.take("bob")
    clock.now_s += 60.0
    lock.take("bob")


def test_nothing_that_was_asked_for_before_the_key_came_takes_effect_after_it():
    bench = Bench()
    desk = Desk(None)  # type: ignore[arg-type]
    with bench.lock.hold("ada"):
        bench.lock.break_open("bob", "a key", DIGEST)
        with pytest.raises(Refusal, match=r"^bob has held the lock since "):
            desk.submit(Kind.LOAD_LAW, axis=0, values=[1.0])
    assert bench.lock.holder is not None
    assert bench.lock.holder["name"] == "bob"


def test_no_key_breaks_it_where_none_is_configured():
    lock = Lock(Clock())
    lock.take("ada")
    for key in ("", "None"):
        with pytest.raises(Refusal, match="no emergency key is configured"):
            lock.break_open("bob", key, None)


@pytest.mark.parametrize("key", ["", "a key", DIGEST.upper(), DIGEST[1:]])
def test_the_configuration_has_a_digest_and_no_key(tmp_path: Path, key: str):
    path = tmp_path / "lab.toml"
    path.write_text(on_a_board(tmp_path, ("[recording]", f'[service]\nemergency_key_sha256 = "{key}"\n[recording]')))
    with pytest.raises(ConfigError, match=r"service\.emergency_key_sha256"):
        load(path)


def test_names_are_found_by_the_recorder_until_others_take_their_place():
    names = RequesterNames.create()
    recorder = RequesterNames(names.fd)
    names.store(17, "ada")
    names.store(18, "é李" * 20)
    assert [recorder.requester(identity) for identity in (0, 16, 17, 18)] == [None, None, "ada", "é李" * 20]
    names.store(17 + 4096, "bob")  # after as many names as the ring of events holds
    assert [recorder.requester(identity) for identity in (17, 17 + 4096)] == [None, "bob"]
    names.close()


def test_an_event_by_a_name_is_the_command_of_an_operator():
    command = message(Kind.SET_MODE, tick=5, values=[3.0])
    event = event_from_message(command[0], ["x"], 0, name="ada")
    assert (event["who"], event_from_message(command[0], ["x"], 0)["who"]) == ("ada", OPERATOR)
    decoded = message_from_event(event, ["x"])
    assert decoded is not None
    assert decoded.tobytes() == command.tobytes()
    assert [name_problem(origin.name.lower()) is None for origin in Origin] == [o is Origin.OPERATOR for o in Origin]

"""The real service with its web application, preparation and loop on the simulated rig, in virtual time, one process.

Every client of this process, `rtloop ctl` too, gets its answers from this service, but without socket, processes and
recorder: each record that the loop makes is kept in `rows`.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any, TypeVar

import numpy as np
import pytest

from rtloop.client import Client
from rtloop.configuration.prepare import prepare
from rtloop.service import service, status
from rtloop.service.api.application import application
from rtloop.service.api.lanes import Lanes, TooManyRequests
from tests.virtual.loop import WATCH_S, VirtualLoop

T = TypeVar("T")


def answer_in_process(application: Any, method: str, resource: str, body: str | bytes | None) -> tuple[int, str, bytes]:
    """Return (HTTP status, content type, body) of the web application's response, computed in the calling thread."""
    sent: list[Any] = []
    data = body.encode() if isinstance(body, str) else body or b""
    requests = iter([{"type": "http.request", "body": data, "more_body": False}])

    async def receive() -> Any:
        for request in requests:
            return request
        return await asyncio.Event().wait()

    async def send(message: Any) -> None:
        sent.append(message)

    path, _, query = resource.partition("?")
    scope = {
        "type": "http", "http_version": "1.1", "method": method, "scheme": "http", "path": path, "headers": [],
        "raw_path": path.encode(), "query_string": query.encode(), "server": ("localhost", 80), "root_path": "",
    }  # fmt: skip
    asyncio.run(application(scope, receive, send))
    kind = dict(sent[0]["headers"]).get(b"content-type", b"").decode()
    return sent[0]["status"], kind, b"".join(message.get("body", b"") for message in sent[1:])


class VirtualBench(VirtualLoop):
    """A service in closed loop, as `tests.faults.bench.Bench`; `text` is its configuration."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
        monkeypatch.setattr(Lanes, "run", _run_in_lane)
        monkeypatch.setattr(status, "timing", lambda _: {})  # an unpaced loop has no lateness
        monkeypatch.setattr(service, "prepare", lambda configuration: prepare(configuration, paced=False))
        super().__init__(folder, monkeypatch, text.replace("FOLDER", str(folder)))
        web = application(self.service)
        monkeypatch.setattr(Client, "exchange", lambda _, *request, **__: answer_in_process(web, *request[:3]))
        self.client = Client(folder / "lab.sock")
        self.rows: list[np.ndarray[Any, Any]] = []
        self.begin_loop()

    def begin_loop(self) -> None:
        """Begin a loop as the service does: off, then prepared and in the configured mode if the service is armed."""
        self.execute()
        if not self.service.configuration.service.arm:
            self.service._is_preparing = True
            self.start(self.service._prepare_and_start)
        self.turns.sleep(WATCH_S)

    def start(self, work: Callable[[], object]) -> Thread:
        """Start a thread in virtual time."""
        return self.turns.start(work)

    def answer(self, method: str, resource: str, body: Any = None) -> tuple[int, Any]:
        """Return the status, and the JSON object or the text of the response."""
        code, kind, data = self.client.exchange(method, resource, json.dumps(body or {}))
        return code, json.loads(data) if "json" in kind else data.decode()

    def answer_meanwhile(self, resource: str, body: Any, meanwhile: Callable[[], T]) -> tuple[T, int, Any]:
        """Post a request in another thread, and call `meanwhile`; return its result, and status and body."""
        answers: list[tuple[int, Any]] = []
        thread = self.start(lambda: answers.append(self.answer("POST", resource, body)))
        result = meanwhile()
        thread.join()
        ((code, response),) = answers
        return result, code, response

    def status(self) -> dict[str, Any]:
        return self.client.get("/status")

    def await_state(self, state: str) -> None:
        self.wait_for(lambda: self.status()["state"] == state, state)

    def await_drive(self) -> None:
        """Wait until the loop runs, and for 1,000 further ticks."""
        self.await_state("running")
        ticks = self.ticks
        self.wait_for(lambda: self.ticks > ticks + 1000, "a thousand ticks")

    @property
    def ticks(self) -> int:
        assert self.loop is not None
        return int(self.loop.block["ticks_head"][0])

    def column(self, signal: str) -> np.ndarray[Any, Any]:
        """Return a signal at all ticks so far."""
        assert self.loop is not None
        return np.concatenate(self.rows)[:, self.loop.plan.columns.index(signal)]

    def executed(self, rows: np.ndarray[Any, Any]) -> None:
        self.rows.append(rows)


async def _run_in_lane(lanes: Lanes, lane: Any, action: Callable[..., T], *arguments: Any) -> T:
    """Run an action of a request in the calling thread; as many requests wait at a time as in the real lanes."""
    if lanes._pending_counts[lane] >= lane.value[1]:
        raise TooManyRequests("too many requests")
    lanes._pending_counts[lane] += 1
    try:
        return action(*arguments)
    finally:
        lanes._pending_counts[lane] -= 1

"""The real service with its web application, preparation and loop on the simulated rig, in virtual time, one process.

Every client of this process, `rtloop ctl` too, gets its answers from this service, but without socket, processes and
recorder: each record that the loop makes is kept in `rows`.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextvars import ContextVar, copy_context
from pathlib import Path
from threading import Thread, current_thread
from typing import Any, TypeVar

import numpy as np
import pytest

from rtloop.client import Client
from rtloop.client.control import UnansweredRequest
from rtloop.configuration.prepare import prepare
from rtloop.recording.file.topics.events import event_from_message
from rtloop.service import service, status
from rtloop.service.api.application import application
from rtloop.service.api.lanes import Lane, Lanes, TooManyRequests
from tests.virtual.loop import WATCH_S, VirtualLoop
from tests.virtual.turns import Turns

T = TypeVar("T")
LOOP_PASSES = 10
"""Passes of the event loop after which a request has noticed that its client is gone."""
client_is_gone = ContextVar[Callable[[], object]]("client_is_gone")


def answer_in_process(
    application: Any,
    method: str,
    resource: str,
    body: str | bytes | None,
    headers: Mapping[str, str] | None = None,
    is_gone: Callable[[], object] = lambda: False,
) -> tuple[int, dict[str, str], bytes]:
    """Return (HTTP status, headers, body) of the web application's response, computed in the calling thread.

    The client disconnects as soon as `is_gone` returns True.
    """
    sent: list[Any] = []
    data = body.encode() if isinstance(body, str) else body or b""
    requests = iter([{"type": "http.request", "body": data, "more_body": False}])

    async def respond() -> None:
        client_is_gone.set(is_gone)
        await application(scope, receive, send)

    async def receive() -> Any:
        for request in requests:
            return request
        while not is_gone():
            await asyncio.sleep(0)
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        sent.append(message)

    path, _, query = resource.partition("?")
    scope = {
        "type": "http", "http_version": "1.1", "method": method, "scheme": "http", "path": path, "root_path": "",
        "raw_path": path.encode(), "query_string": query.encode(), "server": ("localhost", 80),
        "headers": [(name.lower().encode(), value.encode()) for name, value in (headers or {}).items()],
    }  # fmt: skip
    calling_loop = asyncio.events._get_running_loop()  # the panel's, when it forwards a request to the service
    asyncio.events._set_running_loop(None)
    try:
        asyncio.run(respond())
    finally:
        asyncio.events._set_running_loop(calling_loop)
    received = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], received, b"".join(message.get("body", b"") for message in sent[1:])


class VirtualBench(VirtualLoop):
    """A service in closed loop, as `tests.faults.bench.Bench`; `text` is its configuration."""

    poll_s = 0.005

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
        monkeypatch.setattr(Lanes, "run", lambda *arguments: run_in_lane(self.turns, *arguments))
        monkeypatch.setattr(status, "timing", lambda _: {})  # an unpaced loop has no lateness
        monkeypatch.setattr(service, "prepare", lambda configuration: prepare(configuration, paced=False))
        super().__init__(folder, monkeypatch, text.replace("FOLDER", str(folder)))
        self._web, exchange = application(self.service), self._exchange
        monkeypatch.setattr(Client, "exchange", lambda _, *request, **options: exchange(*request, **options))
        self.gone = set[Thread]()
        """Clients, by their thread, whose process was killed: each of their requests loses its connection."""
        self.client = Client(folder / "lab.sock")
        self._messages: list[Any] = []
        self.rows: list[np.ndarray[Any, Any]] = []
        self.begin_loop()

    def begin_loop(self) -> None:
        """Begin a loop as the service does: off, then prepared and in the configured mode if the service is armed."""
        self.execute()
        if not self.service.configuration.service.arm:
            self.service._is_preparing = True
            self.start(self.service._prepare_and_start)
        self.turns.sleep(WATCH_S)

    def _exchange(
        self, method: str, resource: str, body: str | bytes | None, _: float = 0.0, cancellation: Any = None
    ) -> tuple[int, str, bytes]:
        """Return the service's response to a request of a client, as Client.exchange."""
        client = current_thread()
        is_gone = lambda: client in self.gone or (cancellation is not None and cancellation._is_cancelled)
        code, headers, data = answer_in_process(self._web, method, resource, body, is_gone=is_gone)
        if is_gone():
            raise UnansweredRequest(self.client.path, OSError("cancelled"))
        return code, headers.get("content-type", ""), data

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

    def events(self, kind: str) -> list[dict[str, Any]]:
        """Return the loop's events of a kind, as they would be recorded."""
        axes = [axis.name for axis in self.service.configuration.axes]
        assert self.service.supervisor is not None
        name = self.service.supervisor.names.requester
        events = [event_from_message(m, axes, 0, name=name(int(m["identity"]))) for m in self._messages]
        return [dict(event) for event in events if event["kind"] == kind]

    def event(self, kind: str, tick: int, who: str = "operator") -> dict[str, Any]:
        """Return the event of the change at `tick` by the client `who`, as soon as the loop has executed it."""
        (event,) = self.wait_for(
            lambda: [event for event in self.events(kind) if event["tick"] == tick], f"{kind} at {tick}"
        )
        assert event["who"] == who
        return event

    def newest(self, signal: str) -> float:
        """Return a signal at the newest tick."""
        assert self.loop is not None
        return float(self.rows[-1][-1, self.loop.plan.columns.index(signal)])

    def executed(self, rows: np.ndarray[Any, Any]) -> None:
        self.rows.append(rows)
        if self.loop is not None:
            self._messages.extend(self.loop.drain("events"))


async def run_in_lane(turns: Turns, lanes: Lanes, lane: Any, action: Callable[..., T], *arguments: Any) -> T:
    """Run an action of a request in a thread in virtual time, as many at a time as in the real lanes."""
    most_at_a_time, most_pending = lane.value
    if lanes._pending_counts[lane] >= most_pending:
        raise TooManyRequests("too many requests")
    running = lanes.__dict__.setdefault("running", dict.fromkeys(Lane, 0))
    lanes._pending_counts[lane] += 1
    try:
        turns.wait(lambda: running[lane] < most_at_a_time)
        running[lane] += 1
        future, context = Future[T](), copy_context()
        turns.start(lambda: fulfil(future, lambda: context.run(action, *arguments)))
        try:
            return await result_of(turns, future)
        finally:
            running[lane] -= 1
    finally:
        lanes._pending_counts[lane] -= 1


async def result_of(turns: Turns, future: Future[T]) -> T:
    """Wait for a thread's result; the request notices in between that its client is gone."""
    is_gone = client_is_gone.get()
    turns.wait(lambda: future.done() or is_gone())
    for _ in range(LOOP_PASSES):
        await asyncio.sleep(0)
    turns.wait(future.done)
    return future.result()


def fulfil(future: Future[T], action: Callable[[], T]) -> None:
    """Put the result of an action, or its error, into `future`."""
    try:
        future.set_result(action())
    except Exception as error:
        future.set_exception(error)

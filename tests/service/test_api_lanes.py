"""Requests that bring the outputs to rest never wait for other requests. The service is a stand-in."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest

from rtloop.service.api.application import application
from rtloop.service.desk import Refusal
from rtloop.service.lock import Lock

PATIENCE_S = 20.0
WAITING_REQUESTS = 60


class BlockedService:
    """Service whose `start` and `reload_now` block until `let_go` is set; `stop` and `reset` return at once."""

    def __init__(self) -> None:
        self.let_go, self.lock = threading.Event(), Lock()
        self.stopped = 0

    def reload_now(self) -> dict[str, Any]:
        self.let_go.wait()
        return {}

    start = reload_now
    is_ending = False

    def stop(self) -> int:
        self.stopped += 1
        return self.stopped

    reset = stop


async def post(app: Any, path: str) -> int:
    """Return the status of a POST request, which is sent to the application without a socket."""
    sent: list[Any] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "POST", "path": path, "raw_path": path.encode(), "root_path": "",
             "query_string": b"", "headers": [], "http_version": "1.1", "scheme": "http"}  # fmt: skip
    await app(scope, receive, send)
    return sent[0]["status"]


@pytest.mark.parametrize("path", ["/reload", "/start"])
def test_stop_and_reset_wait_for_nobody(path):
    async def send_requests() -> list[int]:
        service = BlockedService()
        app = application(service)  # type: ignore[arg-type]
        tasks = [asyncio.create_task(post(app, path)) for _ in range(WAITING_REQUESTS)]
        await asyncio.sleep(0)
        try:
            codes = [await asyncio.wait_for(post(app, path), PATIENCE_S) for path in ("/stop", "/reset")]
        finally:
            service.let_go.set()
        blocked_codes = await asyncio.gather(*tasks)
        assert service.stopped == 2
        assert set(blocked_codes) == {200, 503}  # requests beyond the limit are refused at once
        return codes

    assert asyncio.run(send_requests()) == [200, 200]


class EndingService:
    """A service whose loop ramps down: `start` is refused because of the mode, as a measurement is."""

    def __init__(self, is_ending: bool) -> None:
        self.is_ending, self.lock = is_ending, Lock()

    def start(self) -> int:
        raise Refusal("start: the mode is not closed_loop but off")


@pytest.mark.parametrize(("is_ending", "code"), [(True, 503), (False, 409)])
def test_a_refusal_by_a_service_that_ends_names_the_end(is_ending: bool, code: int):
    app = application(EndingService(is_ending))  # type: ignore[arg-type]
    assert asyncio.run(post(app, "/start")) == code

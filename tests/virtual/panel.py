"""The panel's web application for a service in virtual time, in the same process, and a page that sends it requests."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import pytest
from click.testing import CliRunner

from rtloop.cli import main
from rtloop.panel.recordings import process_runner
from rtloop.panel.recordings.process_runner import ProcessFailed
from rtloop.panel.service.service import Service
from rtloop.panel.web.application import application
from rtloop.panel.web.security import Session
from tests.panel.route_server import Response
from tests.virtual.bench import VirtualBench, answer_in_process, fulfil, result_of

TOKEN = "token"


class VirtualPage:
    """A logged-in page of a panel, whose commands `rtloop ctl` run in threads in place of processes."""

    host, origin = "127.0.0.1:8321", "http://127.0.0.1:8321"

    def __init__(self, bench: VirtualBench, monkeypatch: pytest.MonkeyPatch) -> None:
        self._bench = bench
        self._panel = application(Service(bench.client.path), Session(TOKEN))
        monkeypatch.setattr(process_runner, "_run_json", self._run_command)
        self._secret = ""
        self._secret = self.json("POST", "/session", {"token": TOKEN})[1]["session"]

    def request(
        self, method: str, path: str, body: Any = None, is_gone: Callable[[], object] = lambda: False
    ) -> Response:
        """Send a request as a page does, which disconnects as soon as `is_gone` returns True."""
        headers = {"Host": self.host, "Origin": self.origin, "Authorization": f"Bearer {self._secret}"}
        data = None if body is None else json.dumps(body)
        return Response(*answer_in_process(self._panel, method, path, data, headers, is_gone))

    def json(self, method: str, path: str, body: Any = None) -> tuple[int, Any]:
        """Send a request; return the status and the JSON of the response, None if it is empty."""
        code, _, data = self.request(method, path, body)
        return code, json.loads(data) if data else None

    async def _run_command(self, command: list[str], stdin: bytes, _: float) -> dict[str, object]:
        """Run `rtloop ...`; the end of this call ends its requests, as if its process had been killed."""
        result = Future[Any]()
        arguments = command[command.index("rtloop") + 1 :]
        client = self._bench.start(
            lambda: fulfil(result, lambda: CliRunner().invoke(main, arguments, input=stdin.decode()))
        )
        try:
            response = json.loads((await result_of(self._bench.turns, result)).stdout)
        except asyncio.CancelledError:
            self._bench.gone.add(client)
            self._bench.turns.wait(result.done)
            raise
        if "error" in response:
            raise ProcessFailed(response["error"], response.get("exit_code"))
        return response

"""Pages of other origins, and a page without the token: neither sees nor moves anything."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

import pytest

from tests.faults.bench import Bench
from tests.panel.page.browser import opened, running, said

ATTACKS = """async (panel) => {
  const tried = {};
  const post = (name, path, options) => fetch(panel + path, {method: "POST", credentials: "include", ...options})
    .then((answer) => (tried[name] = answer.type + answer.status), (error) => (tried[name] = "failed"));
  const body = JSON.stringify({axis: "x", value: 30});
  await post("json", "/api/setpoint?as=ada", {body, headers: {"Content-Type": "application/json"}});
  await post("plain", "/api/setpoint?as=ada", {body, mode: "no-cors", headers: {"Content-Type": "text/plain"}});
  await post("stop", "/api/stop", {mode: "no-cors", body: "{}"});
  await post("mode", "/api/mode?as=ada", {mode: "no-cors", body: '{"mode": "off"}'});
  tried.read = await fetch(panel + "/api/status", {credentials: "include"}).then((a) => a.text(), () => "failed");
  tried.socket = await new Promise((resolve) => {
    const socket = new WebSocket(panel.replace("http", "ws") + "/live");
    socket.onopen = () => resolve("open");
    socket.onerror = () => resolve("failed");
  });
  const form = document.createElement("form");
  Object.assign(form, {method: "post", action: panel + "/api/stop", target: "in"});
  const frame = Object.assign(document.createElement("iframe"), {name: "in"});
  document.body.append(frame, form);
  form.submit();
  await new Promise((resolve) => setTimeout(resolve, 500));
  return tried;
}"""


class Page(BaseHTTPRequestHandler):
    """An empty one."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>elsewhere</title><body></body>")

    def log_message(self, *_: Any) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[str]:
    """A second origin of the same host: to a browser the same site, whose cookies it sends along."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    server.server_close()


def test_a_page_of_another_origin_cannot_move_the_drive(page: Any, bench: Bench, address: str, elsewhere: str) -> None:
    running(page, bench)
    page.fill("#setpoint", "12.5")
    page.keyboard.press("Enter")
    said(page, "#digits", "12.500")
    stranger = page.context.new_page()  # with the session's cookie
    stranger.goto(elsewhere)
    parts = urlsplit(address)
    tried = stranger.evaluate(ATTACKS, f"{parts.scheme}://{parts.netloc}")
    assert tried["json"] == tried["read"] == tried["socket"] == "failed"
    status = bench.status()
    assert status["state"] == "running"
    assert status["mode"] == "closed_loop"
    assert status["axes"]["x"]["reference_um"] == 12.5
    stranger.close()
    page.keyboard.press("Escape")
    page.keyboard.press("Space")
    said(page, "#state-word", "stopped")
    page.click("#release")


def test_the_token_leaves_the_address_and_without_it_there_is_a_form(browser: Any, address: str) -> None:
    page = opened(browser, address)
    assert "token" not in page.url
    assert "#" not in page.url
    page.reload()
    page.wait_for_selector("body:not(.stale)")
    bare, token = address.split("#token=")
    stranger = browser.new_context().new_page()
    stranger.goto(bare)
    stranger.wait_for_selector("#token-dialog[open]")
    stranger.fill("#token", "not-it")
    stranger.keyboard.press("Enter")
    said(stranger, "#token-error", "not the token")
    stranger.fill("#token", token)
    stranger.keyboard.press("Enter")
    stranger.wait_for_selector("body:not(.stale)")
    assert "rtloop" not in stranger.evaluate("document.cookie")
    stranger.context.close()
    page.context.close()

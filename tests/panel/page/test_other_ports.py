"""Servers of another user, on other ports of the panel's address and on its own after it, receive no secret."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import IO, Any
from urllib.parse import urlsplit

import pytest

from tests.faults.bench import Bench
from tests.panel.page.browser import await_text, open_panel, start_by_client, start_panel, stop_by_keyboard
from tests.panel.route_server import exchange
from tests.users import ATTACKER, as_user

pytestmark = pytest.mark.system


@contextmanager
def server_of_another_user(host: str, port: int = 0) -> Iterator[tuple[str, IO[str]]]:
    """Yield the address of a server on `host`, and a file in which each line has the headers of a request as JSON.

    The server is another user's process; without root it is this user's, which makes no difference to a browser. A
    page that asks it for a proof gets a wrong one.
    """
    received, sender = os.pipe()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            os.write(sender, (json.dumps({"Path": self.path, **self.headers}) + "\n").encode())
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b'{"proof": "0"}' if "nonce" in self.path else b"<!doctype html><title>elsewhere</title>")

        do_POST = do_GET

        def log_message(self, format: str, *_: Any) -> None:
            """Log no request to the terminal."""

    with closing(socket.create_server((host, port))) as listener:
        pid = os.fork()
        if pid == 0:
            try:
                if os.geteuid() == 0:
                    os.setgroups(())
                    os.setresgid(ATTACKER, ATTACKER, ATTACKER)
                    os.setresuid(ATTACKER, ATTACKER, ATTACKER)
                server = HTTPServer((host, 0), Handler, bind_and_activate=False)
                server.socket.close()
                server.socket = listener
                server.serve_forever()
            finally:
                os._exit(1)
        os.close(sender)
        try:
            with os.fdopen(received) as file:
                yield f"http://{host}:{listener.getsockname()[1]}", file
        finally:
            os.kill(pid, 9)
            os.waitpid(pid, 0)


def test_a_page_on_another_port_gets_no_secret_and_starts_no_loop(page: Any, bench: Bench, address: str) -> None:
    panel = urlsplit(address)
    host = str(panel.hostname)
    with server_of_another_user(host) as (stranger, received):
        tab = page.context.new_page()
        tab.goto(stranger)
        forged = json.loads(received.readline())
        tab.evaluate("(url) => { document.body.append(Object.assign(new Image(), {src: url})) }", f"{stranger}/image")
        forged |= json.loads(received.readline())
        tab.close()
    forged |= {"Host": panel.netloc, "Origin": f"http://{panel.netloc}", "Sec-Fetch-Site": "same-origin"}

    def forge(command: str) -> int:
        send = lambda: exchange(int(panel.port or 0), "POST", f"/api/{command}?as=mallory", {}, forged, host).code
        return as_user(ATTACKER, send) if os.geteuid() == 0 else send()

    assert [forge("arm"), forge("start")] == [401, 401], bench.status()["state"]
    assert bench.status()["state"] == "stopped"
    await_text(page, "#state-word", "stopped")


def test_a_page_whose_panel_has_died_sends_its_secret_to_nobody_else(browser: Any, bench: Bench) -> None:
    address, process = start_panel(bench)
    page = open_panel(browser, address)
    secret = page.evaluate("sessionStorage.getItem('rtloop-session')")
    panel = urlsplit(address)
    process.kill()
    process.wait()
    page.wait_for_selector("body.stale")
    page.wait_for_function("() => sessionStorage.length === 0")  # A reload may load another server's page.
    with server_of_another_user(str(panel.hostname), int(panel.port or 0)) as (_, received):
        requests = [received.readline() for _ in range(4)]
        page.keyboard.press("Space")
        while not any("/api/stop" in request for request in requests):
            requests.append(received.readline())
    assert any("/session?nonce=" in request for request in requests)
    assert len(secret) == 32
    assert secret not in "".join(requests)
    page.context.close()


def test_a_second_tab_and_a_reload_need_no_token_and_a_download_has_the_bytes_of_the_file(
    page: Any, bench: Bench, address: str
) -> None:
    tab = page.context.new_page()
    tab.goto(address.partition("#")[0])
    tab.wait_for_selector("body:not(.stale)")
    tab.reload()
    tab.wait_for_selector("body:not(.stale)")
    assert page.context.cookies() == []
    start_by_client(page, bench)
    stop_by_keyboard(page)
    tab.keyboard.press("5")
    row = tab.locator("#recording-list tbody tr").last
    with tab.expect_download() as download:
        row.get_by_role("button", name="Download of").click()
    file = next((bench.folder / "recordings").glob(f"{row.locator('th').inner_text().removesuffix('.part')}*"))
    assert download.value.path().read_bytes()[:8] == file.read_bytes()[:8] == b"\x89MCAP0\r\n"
    row.get_by_role("button", name="Plot of").click()
    tab.wait_for_function("() => document.querySelector('#recording-shown img')?.naturalWidth > 0")
    tab.close()

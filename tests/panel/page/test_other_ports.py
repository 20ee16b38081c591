"""Servers of another user, on other ports of the panel's address, receive nothing from the browser that drives a loop."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import IO, Any
from urllib.parse import urlsplit

from tests.faults.bench import Bench
from tests.panel.page.browser import await_text
from tests.panel.route_server import exchange
from tests.users import ATTACKER, as_user


@contextmanager
def server_of_another_user(host: str) -> Iterator[tuple[str, IO[str]]]:
    """Yield the address of a server on `host`, and a file in which each line has the headers of a request as JSON.

    The server is another user's process; without root it is this user's, which makes no difference to a browser.
    """
    received, sender = os.pipe()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            os.write(sender, (json.dumps(dict(self.headers)) + "\n").encode())
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>elsewhere</title>")

        def log_message(self, format: str, *_: Any) -> None:
            """Log no request to the terminal."""

    with closing(socket.create_server((host, 0))) as listener:
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

"""HTTP requests on a UNIX socket: status and body are returned, also of error responses."""

from __future__ import annotations

import json
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

from tests.faults.bench import Bench

TIMEOUT_S = 20.0
GOOD_CONTROLLER = {
    "form": "zpk",
    "gain": 60.0,
    "poles": [[-0.5, 0.0]],
    "method": "tustin",
}


def exchange(path: Path, method: str, resource: str, body: bytes = b"") -> tuple[int, bytes]:
    """Return status and body of a request. A server may respond and disconnect before it has read the request."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.connect(str(path))
        connection.settimeout(TIMEOUT_S)
        head = f"{method} {resource} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Length: {len(body)}"
        with suppress(BrokenPipeError, ConnectionResetError):
            connection.sendall(head.encode() + b"\r\n\r\n" + body)
        data = b""
        with suppress(ConnectionResetError):
            while part := connection.recv(1 << 16):
                data += part
    status, _, remainder = data.partition(b"\r\n")
    return int(status.split()[1]), remainder.partition(b"\r\n\r\n")[2]


def answer(bench: Bench, method: str, resource: str, body: Any = None) -> tuple[int, Any]:
    """Return the status, and the JSON object or the text of the response."""
    code, data = exchange(bench.client.path, method, resource, json.dumps(body or {}).encode())
    text = data.decode()
    return code, json.loads(text) if text.startswith("{") else text

"""One HTTP exchange on a UNIX socket, with the status and the body whatever they are."""

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
    """Status and body; a server may answer before it has read everything, and hang up."""
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
    status, _, rest = data.partition(b"\r\n")
    return int(status.split()[1]), rest.partition(b"\r\n\r\n")[2]


def answer(bench: Bench, method: str, resource: str, body: Any = None) -> tuple[int, Any]:
    """Status, and the JSON object or the text of an answer."""
    code, data = exchange(bench.client.path, method, resource, json.dumps(body or {}).encode())
    text = data.decode()
    return code, json.loads(text) if text.startswith("{") else text

"""`rtloop panel`: a web server for this host alone, until SIGINT or SIGTERM."""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import signal
import socket
import stat
import webbrowser
from collections.abc import Callable
from pathlib import Path

import uvicorn

from rtloop.errors import OutputError, UnavailableError
from rtloop.foundation.trusted import UntrustedPath, open_file
from rtloop.panel.foxglove.endpoint import PATH, viewers_token
from rtloop.panel.protocol.subscriptions import MAX_MESSAGE_BYTES
from rtloop.panel.service.service import Service
from rtloop.panel.web.application import MAX_TOKEN_BYTES, application
from rtloop.panel.web.live import Stream
from rtloop.panel.web.security import TOKEN_BYTES, Sessions
from rtloop.service.api.connections import BoundedConnection
from rtloop.supervision.paths import host_refusal

HOST = "127.0.0.1"
NICE = 10
MAX_CONNECTIONS = 32
BACKLOG = 64
SEND_BUFFER_BYTES = 1 << 17
"""Send buffer of the kernel for each client; frames in it are old when the client reads them."""
TOKEN_MODE = 0o640


class LimitedConnections(BoundedConnection):
    """HTTP connection, of which MAX_CONNECTIONS may be open; `Live` counts WebSockets."""

    max_connections = MAX_CONNECTIONS


def serve(control: Path, port: int, token_file: Path | None, print_address: Callable[[str], None], open_browser: bool,
          foxglove: bool = False) -> int:  # fmt: skip
    """Serve the panel of the service at `control` on 127.0.0.1:`port` until SIGINT or SIGTERM. Returns 0.

    `port` 0 is any free one. `token_file` None: a new token for each start. `print_address` receives the address with
    the token, and with `foxglove` also the address for viewers. The process gets a low CPU priority, and handles both
    signals. Raises UnavailableError for a port that cannot be used, and OutputError and HostRefusal as
    `read_or_make_token`.
    """
    token = secrets.token_urlsafe(TOKEN_BYTES) if token_file is None else read_or_make_token(token_file)
    listener = _listen(port)
    port = listener.getsockname()[1]
    with contextlib.suppress(OSError):
        os.nice(NICE)
    address = f"http://{HOST}:{port}/#token={token}"
    print_address(address)
    viewers = viewers_token(token) if foxglove else None
    if viewers is not None:
        print_address(f"ws://{HOST}:{port}{PATH}?token={viewers}")
    if open_browser:
        webbrowser.open(address)
    server = uvicorn.Server(_server_config(application(Service(control), Sessions(token, port), viewers)))

    def end(*_: object) -> None:
        """Handle a signal: let the server end, also if it has not begun."""
        server.should_exit = True

    for number in (signal.SIGINT, signal.SIGTERM):  # uvicorn handles them while it serves, and raises them again.
        signal.signal(number, end)
    try:
        asyncio.run(server.serve(sockets=[listener]))
    finally:
        listener.close()
    return 0


def read_or_make_token(file: Path) -> str:
    """Return the token in a file; a missing file is made with mode TOKEN_MODE and a new token.

    Raises OutputError for a file that cannot be made or read, that others may read, or with a token that is too short;
    HostRefusal for a file that another user made or may change.
    """
    try:
        return _read_or_make_token(file)
    except UntrustedPath as error:
        raise host_refusal(error) from None


def _read_or_make_token(file: Path) -> str:
    """Do the work of `read_or_make_token`; raises UntrustedPath in place of HostRefusal."""
    try:
        fd = open_file(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, TOKEN_MODE)
        try:
            os.fchmod(fd, TOKEN_MODE)
            os.write(fd, (secrets.token_urlsafe(TOKEN_BYTES) + "\n").encode())
        except OSError:  # An empty file would be refused from now on.
            file.unlink(missing_ok=True)
            raise
        finally:
            os.close(fd)
    except FileExistsError:
        pass
    except UntrustedPath:
        raise
    except OSError as error:
        raise OutputError(f"{file}: cannot create the file of the panel's token: {error.strerror}") from None
    try:
        with os.fdopen(open_file(file, os.O_RDONLY), encoding="ascii") as token_file:
            mode, token = os.fstat(token_file.fileno()).st_mode, token_file.read(MAX_TOKEN_BYTES).strip()
    except UntrustedPath:
        raise
    except (OSError, ValueError) as error:
        raise OutputError(f"{file}: cannot read the panel's token: {error}") from None
    if stat.S_IMODE(mode) & 0o007:
        raise OutputError(f"{file}: other users may read or write the panel's token; use chmod {TOKEN_MODE:o}")
    if len(token) < TOKEN_BYTES:
        raise OutputError(
            f"{file}: the token has {len(token)} characters; allowed: at least {TOKEN_BYTES}; remove the file, so "
            "that the panel makes a new token"
        )
    return token


def _listen(port: int) -> socket.socket:
    """Return a listening socket on HOST; port 0 means any free one. Raises UnavailableError if the system refuses."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        listener.bind((HOST, port))
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise UnavailableError(f"{HOST}:{port}: {error.strerror}; use --port with another port") from None
    return listener


def _server_config(application: object) -> uvicorn.Config:
    """Return uvicorn's settings for the panel: bounded connections and messages, warnings alone in the log."""
    return uvicorn.Config(
        application,  # type: ignore[arg-type]
        http=LimitedConnections,
        ws=Stream,
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_per_message_deflate=False,
        log_level="warning",
        log_config=None,
        proxy_headers=False,
        server_header=False,
        backlog=BACKLOG,
        timeout_graceful_shutdown=1,
    )

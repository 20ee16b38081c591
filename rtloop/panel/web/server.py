"""`rtloop panel`: a web server for this host alone, on an address of its own, until SIGINT or SIGTERM."""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import signal
import socket
import tempfile
import webbrowser
from collections.abc import Callable
from pathlib import Path

import uvicorn

from rtloop.errors import OutputError, UnavailableError
from rtloop.foundation.trusted import UntrustedPath, make_file, replace_file
from rtloop.panel.foxglove.endpoint import PATH, viewers_token
from rtloop.panel.protocol.subscriptions import MAX_MESSAGE_BYTES
from rtloop.panel.service.service import Service
from rtloop.panel.web.application import application
from rtloop.panel.web.live import Stream
from rtloop.panel.web.security import TOKEN_BYTES, Session
from rtloop.service.api.connections import BoundedConnection
from rtloop.supervision.paths import host_refusal

NICE = 10
MAX_CONNECTIONS = 32
BACKLOG = 64
PREFIX = "rtloop-panel-"
SEND_BUFFER_BYTES = 1 << 17
"""Send buffer of the kernel for each client; frames in it are old when the client reads them."""
LINK_MODE = 0o640


class LimitedConnections(BoundedConnection):
    """HTTP connection, of which MAX_CONNECTIONS may be open; `Live` counts WebSockets."""

    max_connections = MAX_CONNECTIONS


def serve(control: Path, port: int, link_file: Path | None, print_address: Callable[[str], None], open_browser: bool,
          foxglove: bool = False, address: str | None = None) -> int:  # fmt: skip
    """Serve the panel of the service at `control` on `address`:`port` until SIGINT or SIGTERM. Returns 0.

    `address` is in 127.0.0.0/8, None: `own_address`. `port` 0 is any free one. `print_address` receives the link with
    the token, or, if `link_file` receives it, the address without the token and the file's name; with `foxglove` also
    the address for viewers. The process gets a low CPU priority, and handles both signals. Raises UnavailableError for
    a port that cannot be used, and OutputError and HostRefusal as `write_link`.
    """
    token, address = secrets.token_urlsafe(TOKEN_BYTES), address or own_address()
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(_listen(address, port))
        place = f"{address}:{listener.getsockname()[1]}"
        link = f"http://{place}/#token={token}"
        with contextlib.suppress(OSError):
            os.nice(NICE)
        if link_file is None:
            print_address(link)
        else:  # What a service prints is in the journal, for more readers than the file has.
            write_link(link_file, link)
            print_address(f"http://{place}/ (with its token: {link_file})")
        viewers = viewers_token(token) if foxglove else None
        if viewers is not None:
            print_address(f"ws://{place}{PATH}?token={viewers}")
        if open_browser:
            webbrowser.open(_private_link(link, Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=PREFIX)))))
        server = uvicorn.Server(_server_config(application(Service(control), Session(token), viewers)))

        def end(*_: object) -> None:
            """Handle a signal: let the server end, also if it has not begun."""
            server.should_exit = True

        for number in (signal.SIGINT, signal.SIGTERM):  # uvicorn handles them while it serves, and raises them again.
            signal.signal(number, end)
        asyncio.run(server.serve(sockets=[listener]))
    return 0


def own_address() -> str:
    """Return a new address in 127.0.0.0/8, which nobody can foresee.

    On a known address another user could have served pages before, which a browser stores: a service worker, or a
    script in its cache, would then get the token of a later panel.
    """
    return f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"


def write_link(file: Path, link: str) -> None:
    """Write the link with the token to a new file of mode LINK_MODE, in place of the file of an earlier panel.

    Raises OutputError for a file that cannot be written, HostRefusal for one that another user made.
    """
    try:
        fd = replace_file(file, LINK_MODE)
        try:
            os.fchmod(fd, LINK_MODE)
            os.write(fd, f"{link}\n".encode())
        except OSError:
            file.unlink(missing_ok=True)
            raise
        finally:
            os.close(fd)
    except UntrustedPath as error:
        raise host_refusal(error) from None
    except OSError as error:
        raise OutputError(f"{file}: cannot write the panel's address: {error.strerror}") from None


def _private_link(link: str, folder: Path) -> str:
    """Return the address of a page in a private `folder` that leads to `link`.

    The browser gets this address on its command line, which all users of the host can read.
    """
    page = folder / "panel.html"
    with os.fdopen(make_file(page, 0o600), "w", encoding="ascii") as file:
        file.write(f'<!doctype html><title>rtloop</title><meta http-equiv="refresh" content="0; url={link}">')
    return page.as_uri()


def _listen(address: str, port: int) -> socket.socket:
    """Return a listening socket; port 0 means any free one. Raises UnavailableError if the system refuses."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        listener.bind((address, port))
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise UnavailableError(f"{address}:{port}: {error.strerror}; use --port with another port") from None
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

"""Access to the panel: for clients on this host with its token, from the panel's own page.

A browser sends requests for every page that is open in it. Therefore the Host header must be an address of this host
(a name could resolve to it), the origin must be the panel's page, and each request carries the secret of the session in
a header that only the panel's page can send. It is no cookie: browsers send cookies to all ports of a host, and another
user may listen on each.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Callable
from ipaddress import AddressValueError, IPv4Address
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK_NAMES = frozenset(("localhost", "::1"))
TOKEN_BYTES = 24
SAFE_METHODS = frozenset(("GET", "HEAD"))
PROTOCOL, SECRET_PROTOCOL = "rtloop", "rtloop.session."
"""Protocols that a page offers for its WebSocket: the first is accepted, the second has the session's secret behind it.

A page cannot give a WebSocket any other header.
"""
HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


class Session:
    """The panel's token, and the secret of the session that it opens, which all pages share until the panel ends."""

    def __init__(self, token: str) -> None:
        self._token, self._secret = token, secrets.token_urlsafe(TOKEN_BYTES)

    def secret_for(self, token: str) -> str | None:
        """Return the secret of the session; None for a wrong token."""
        return self._secret if hmac.compare_digest(token.encode(errors="replace"), self._token.encode()) else None

    def prove(self, nonce: str) -> str:
        """Return the HMAC-SHA256 of a page's `nonce`, in hexadecimal, by which the page knows this panel again."""
        return hmac.new(self._secret.encode(), nonce.encode(errors="replace"), hashlib.sha256).hexdigest()

    def admits(self, scope: Scope) -> bool:
        """Return whether a request has the secret: as `Authorization: Bearer SECRET`, or in a WebSocket's protocol."""
        if scope["type"] == "websocket":
            offered = [name.removeprefix(SECRET_PROTOCOL) for name in scope["subprotocols"] if name != PROTOCOL]
        else:
            offered = [text.removeprefix("Bearer ") for text in Headers(scope=scope).getlist("authorization")]
        return len(offered) == 1 and hmac.compare_digest(offered[0].encode(errors="replace"), self._secret.encode())


class Guard:
    """Middleware that admits requests from the panel's own pages on this host with a session; pages need no session.

    `is_admitted` returns True for a request that is admitted without a session, whatever its origin; its Host header
    must still name this host.
    """

    def __init__(self, app: ASGIApp, session: Session, is_admitted: Callable[[Scope], bool] = lambda _: False) -> None:
        """Store the application behind the guard, its session and the test `is_admitted`, by default always False."""
        self._app, self._session, self._is_admitted = app, session, is_admitted

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request with 403 or 401 (a WebSocket by closing it), or forward it; responses get the HEADERS.

        A message that is neither a request nor a WebSocket, such as the server's start, is forwarded unchecked.
        """
        if scope["type"] not in ("http", "websocket"):
            return await self._app(scope, receive, send)

        async def send_guarded(message: Message) -> None:
            """Send a message with the security headers, which a response may override."""
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                headers.setdefault("cache-control", "no-store")
            await send(message)

        if refusal := self._refusal(scope):
            if scope["type"] == "websocket":
                return await send({"type": "websocket.close", "code": 1008})
            return await refusal(scope, receive, send_guarded)
        return await self._app(scope, receive, send_guarded)

    def _refusal(self, scope: Scope) -> Response | None:
        """Return the response that refuses a request; None to admit.

        403 for a Host header that does not name this host. Unless `is_admitted`: the page under a name of this host
        leads to its address, where no other server can listen, and other requests by name get 403; 403 for an origin
        that is not the panel's page, and for a WebSocket or a command without an origin (a command with
        `sec-fetch-site: same-origin` is admitted); 401 without the session's secret on a path that is not public.
        """
        headers, path = Headers(scope=scope), scope["path"]
        host, origin = headers.get("host", ""), headers.get("origin")
        name = host_name(host)
        by_name = name in LOOPBACK_NAMES
        if len(headers.getlist("host")) != 1 or not (by_name or is_loopback(name)):
            return _refuse(403, f"host {host[:100]!r}: not allowed; allowed: 127.0.0.1; elsewhere use ssh -L")
        if self._is_admitted(scope):
            return None
        if by_name:
            port = urlsplit(f"//{host}").port
            address = f"http://127.0.0.1{f':{port}' if port else ''}/"
            if (path, scope.get("method")) == ("/", "GET"):
                return RedirectResponse(address)
            return _refuse(403, f"host {host[:100]!r}: not allowed; allowed: the address, such as {address}")
        if len(headers.getlist("origin")) > 1 or (origin is not None and origin.lower() != f"http://{host.lower()}"):
            return _refuse(403, f"origin {str(origin)[:100]!r}: not allowed; allowed: http://{host}")
        if origin is None:
            is_same_origin = headers.get("sec-fetch-site") == "same-origin"
            if scope["type"] == "websocket" or (scope["method"] not in SAFE_METHODS and not is_same_origin):
                return _refuse(403, "origin: missing; allowed: the origin of the panel's page")
        if is_public(path) or self._session.admits(scope):
            return None
        return _refuse(401, "no session: open the panel with the address that `rtloop panel` printed, token included")


def _refuse(code: int, reason: str) -> Response:
    return JSONResponse({"error": reason}, status_code=code)


def is_public(path: str) -> bool:
    """Return whether a path needs no session: the pages, which contain no data, the log-in, the icon, and downloads,
    whose path is a ticket.
    """
    return path in ("/", "/session", "/favicon.ico") or path.startswith(("/page/", "/download/"))


def is_loopback(name: str) -> bool:
    """Return whether a host's name is an IPv4 address in 127.0.0.0/8, written in full."""
    try:
        return IPv4Address(name).is_loopback
    except AddressValueError:
        return False


def host_name(host: str) -> str:
    """Return the name in a Host header, in lower case, without port and brackets; "" for an invalid header."""
    try:
        parts = urlsplit(f"//{host}")
        return (parts.hostname or "") if parts.netloc == host and parts.port != 0 and "@" not in host else ""
    except ValueError:
        return ""

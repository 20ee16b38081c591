"""Access to the panel: for clients on this host with its token, from the panel's own page.

A browser sends requests for every page that is open in it. Therefore the Host header must name this host (any other
name could resolve to it), the origin must be the panel's page, and the session is a cookie that other sites' pages
cannot send.
"""

from __future__ import annotations

import hmac
import secrets
from collections import OrderedDict
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK = frozenset(("127.0.0.1", "localhost", "::1"))
MAX_SESSIONS = 256
TOKEN_BYTES = 24
SAFE_METHODS = frozenset(("GET", "HEAD"))
HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


class Sessions:
    """The token, and the sessions opened with it: the newest MAX_SESSIONS, until the panel ends.

    `cookie` is the name of the sessions' cookie, with the panel's `port`: browsers send cookies to all ports of a host.
    """

    def __init__(self, token: str, port: int) -> None:
        """Store the token and name the cookie after the panel's port; no session is open yet."""
        self._token, self.cookie = token, f"rtloop-{port}"
        self._secrets: OrderedDict[str, None] = OrderedDict()

    def open_session(self, token: str) -> str | None:
        """Open a session and return its secret, the cookie's value; None, without a session, for a wrong token.

        Beyond MAX_SESSIONS the oldest session ends.
        """
        if not hmac.compare_digest(token.encode(errors="replace"), self._token.encode()):
            return None
        session = secrets.token_urlsafe(TOKEN_BYTES)
        self._secrets[session] = None
        while len(self._secrets) > MAX_SESSIONS:
            self._secrets.popitem(last=False)
        return session

    def has_session(self, headers: Headers) -> bool:
        """Return whether a request's cookie belongs to an open session."""
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(self.cookie)
        except CookieError:
            return False
        return cookie is not None and cookie.value in self._secrets


class Guard:
    """Middleware that admits requests from the panel's own pages on this host with a session; pages need no session.

    `is_admitted` returns True for a request that is admitted without a session, whatever its origin; its Host header
    must still name this host.
    """

    def __init__(
        self, app: ASGIApp, sessions: Sessions, is_admitted: Callable[[Scope], bool] = lambda _: False
    ) -> None:
        """Store the application behind the guard, its sessions and the test `is_admitted`, by default always False."""
        self._app, self._sessions, self._is_admitted = app, sessions, is_admitted

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
            code, reason = refusal
            return await JSONResponse({"error": reason}, status_code=code)(scope, receive, send_guarded)
        return await self._app(scope, receive, send_guarded)

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Return HTTP status and reason of a refusal; None to admit.

        403 for a Host header that does not name this host. Unless `is_admitted`: 403 for an origin that is not the
        panel's page, 403 for a WebSocket or a command without an origin (a command with `sec-fetch-site: same-origin`
        is admitted), 401 without a session on a path that is not public.
        """
        headers, path = Headers(scope=scope), scope["path"]
        host, origin = headers.get("host", ""), headers.get("origin")
        if len(headers.getlist("host")) != 1 or host_name(host) not in LOOPBACK:
            return (
                403,
                f"host {host[:100]!r}: not allowed; allowed: 127.0.0.1 and localhost; from another computer use ssh -L",
            )
        if self._is_admitted(scope):
            return None
        if len(headers.getlist("origin")) > 1 or (origin is not None and origin.lower() != f"http://{host.lower()}"):
            return 403, f"origin {str(origin)[:100]!r}: not allowed; allowed: http://{host}"
        if origin is None:
            is_same_origin = headers.get("sec-fetch-site") == "same-origin"
            if scope["type"] == "websocket" or (scope["method"] not in SAFE_METHODS and not is_same_origin):
                return 403, "origin: missing; allowed: the origin of the panel's page"
        if is_public(path) or self._sessions.has_session(headers):
            return None
        return 401, "no session: open the panel with the address that `rtloop panel` printed, token included"


def is_public(path: str) -> bool:
    """Return whether a path needs no session: the pages, which contain no data, the log-in and the icon."""
    return path in ("/", "/session", "/favicon.ico") or path.startswith("/page/")


def host_name(host: str) -> str:
    """Return the name in a Host header, in lower case, without port and brackets; "" for an invalid header."""
    try:
        parts = urlsplit(f"//{host}")
        return (parts.hostname or "") if parts.netloc == host and parts.port != 0 and "@" not in host else ""
    except ValueError:
        return ""


def session_cookie(sessions: Sessions, session: str) -> dict[str, Any]:
    """Return the arguments of `Response.set_cookie` for a session; `session` is its secret."""
    return {"key": sessions.cookie, "value": session, "path": "/", "httponly": True, "samesite": "strict"}

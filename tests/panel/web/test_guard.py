"""The guard's verdict on single requests, forged by a client that may send any header but does not know the secret."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from rtloop.panel.web.security import Guard, Session

PANEL = "127.83.12.9:8321"
SESSION = Session("the-token-of-this-panel")
SECRET = SESSION.secret_for("the-token-of-this-panel") or ""
PAGE = {"host": PANEL, "origin": f"http://{PANEL}", "sec-fetch-site": "same-origin"}
COOKIES = {"cookie": f"rtloop-8321={SECRET}; rtloop={SECRET}; session={SECRET}"}


def verdict(kind: str, method: str, path: str, headers: dict[str, str], protocols: tuple[str, ...] = ()) -> int:
    """Return the status of the guard's response, 200 from the application; a WebSocket is closed with 1008."""
    codes: list[int] = []
    query = path.partition("?")[2].encode()
    scope: dict[str, Any] = {"type": kind, "path": path.partition("?")[0], "query_string": query}
    scope["headers"] = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope |= {"method": method} if kind == "http" else {"subprotocols": list(protocols)}

    async def application(*_: Any) -> None:
        codes.append(200)

    async def send(message: Any) -> None:
        codes.extend(message[key] for key in ("status", "code") if key in message)

    async def receive() -> Any:
        raise AssertionError("the guard reads no body")

    asyncio.run(Guard(application, SESSION)(scope, receive, send))
    return codes[0]


def test_the_secret_in_the_header_of_the_panels_page_is_admitted():
    assert verdict("http", "POST", "/api/start", PAGE | {"authorization": f"Bearer {SECRET}"}) == 200
    assert verdict("websocket", "", "/live", PAGE, ("rtloop", f"rtloop.session.{SECRET}")) == 200


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        (PAGE, 401),
        (PAGE | COOKIES, 401),
        (PAGE | {"authorization": "Bearer "}, 401),
        (PAGE | {"authorization": "Bearer the-token-of-this-panel"}, 401),
        (PAGE | {"authorization": f"Bearer {SECRET[:-1]}"}, 401),
        (PAGE | {"sec-websocket-protocol": f"rtloop, rtloop.session.{SECRET}"}, 401),
        (PAGE | {"x-forwarded-host": PANEL, "referer": f"http://{PANEL}/#token={SECRET}"}, 401),
        (PAGE | {"host": "evil.example", "authorization": f"Bearer {SECRET}"}, 403),
        (
            PAGE | {"host": "localhost:8321", "origin": "http://localhost:8321", "authorization": f"Bearer {SECRET}"},
            403,
        ),
        (PAGE | {"origin": "http://127.83.12.9:8322", "authorization": f"Bearer {SECRET}"}, 403),
        (PAGE | {"origin": "null", "authorization": f"Bearer {SECRET}"}, 403),
        ({"host": PANEL, "authorization": f"Bearer {SECRET}"}, 403),
    ],
)
def test_a_forged_start_is_refused(headers: dict[str, str], code: int):
    assert verdict("http", "POST", "/api/start", headers) == code
    assert verdict("http", "POST", f"/api/start?session={SECRET}&token={SECRET}", headers) == code


@pytest.mark.parametrize(
    ("headers", "protocols"),
    [
        (PAGE, ()),
        (PAGE | COOKIES | {"authorization": f"Bearer {SECRET}"}, ("rtloop",)),
        (PAGE, ("rtloop", "rtloop.session.")),
        (PAGE, ("rtloop", f"rtloop.session.{SECRET}", "rtloop.session.x")),
        (PAGE | {"origin": "http://127.83.12.9:8322"}, ("rtloop", f"rtloop.session.{SECRET}")),
        ({"host": PANEL}, ("rtloop", f"rtloop.session.{SECRET}")),
    ],
)
def test_a_forged_stream_is_refused(headers: dict[str, str], protocols: tuple[str, ...]):
    assert verdict("websocket", "", "/live", headers, protocols) == 1008

"""The panel's web application: pages, sessions, description of the loop, control API, recordings, and `/live`."""

from __future__ import annotations

import mimetypes
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import anyio.to_thread
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles

from rtloop.errors import RtloopError
from rtloop.panel.feed.feed import Feed
from rtloop.panel.foxglove.endpoint import Foxglove
from rtloop.panel.service.service import Service
from rtloop.panel.service.state import StateListener
from rtloop.panel.web.live import Live
from rtloop.panel.web.loop_description import describe_loop
from rtloop.panel.web.measure import measure
from rtloop.panel.web.proxy import Proxy
from rtloop.panel.web.rates import ClientRateLimits, identify_client
from rtloop.panel.web.recordings import Recordings
from rtloop.panel.web.responses import (
    PlainJSONResponse,
    RequestRefused,
    decode_json,
    limited_body,
    with_error_responses,
)
from rtloop.panel.web.retuning import Retuning
from rtloop.panel.web.security import Guard, Session

PAGE = Path(__file__).resolve().parents[1] / "page"
MAX_TOKEN_BYTES, MAX_NONCE = 4096, 100


class Pages(StaticFiles):
    """Files of the page, which browsers revalidate each time, because they change with the program."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        """Return the file, or the status 304 if the browser's copy is current, with `cache-control: no-cache`."""
        response = super().file_response(*args, **kwargs)
        response.headers["cache-control"] = "no-cache"
        return response


def application(service: Service, session: Session, viewers_token: str | None = None) -> Starlette:
    """Return the panel's web application for a service; its threads read the loop while the server runs.

    With `viewers_token` it also serves viewers of the Foxglove protocol whose address contains this token.
    """
    feed, state, login_rates = Feed(service), StateListener(service.client), ClientRateLimits(per_s=5.0, burst=20)
    mimetypes.add_type("text/javascript", ".js")

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        """Start the threads that read ticks and state before the server runs; stop the reader of ticks after it."""
        feed.start()
        state.start()
        yield
        await anyio.to_thread.run_sync(feed.stop)

    async def index(_: Request) -> Response:
        """Respond with the page `index.html`."""
        return FileResponse(PAGE / "index.html", headers={"cache-control": "no-cache"})

    @with_error_responses
    async def log_in(request: Request) -> Response:
        """Exchange the `token` in the JSON body for the `session`, the secret that admits requests.

        401 for a wrong or missing token, 429 after too many tries of a client.
        """
        if not login_rates.allows(identify_client(request.scope)):
            raise RequestRefused(429, f"too many attempts to log in; allowed: {login_rates}; try again later")
        try:
            message = decode_json(await limited_body(request, MAX_TOKEN_BYTES))
        except (ValueError, RequestRefused):
            message = None
        token = message.get("token") if isinstance(message, dict) else None
        secret = session.secret_for(token) if isinstance(token, str) else None
        if secret is None:
            raise RequestRefused(
                401, "token: not the token of the running panel; open the address that `rtloop panel` printed"
            )
        return JSONResponse({"session": secret})

    @with_error_responses
    async def prove(request: Request) -> Response:
        """Respond with the `proof` for the `nonce` in the query, without which a page sends its secret to nobody."""
        nonce = request.query_params.get("nonce", "")
        if not 0 < len(nonce) <= MAX_NONCE:
            raise RequestRefused(422, f"nonce: {len(nonce)} characters; allowed: 1 to {MAX_NONCE}")
        return JSONResponse({"proof": session.prove(nonce)})

    def panel(_: Request) -> Response:
        """Respond with the description of the running loop; 503 without one."""
        try:
            return JSONResponse(describe_loop(service.describe()))
        except RtloopError as error:
            return PlainJSONResponse({"error": str(error)}, 503)

    routes: Sequence[BaseRoute] = [
        Route("/", index),
        Mount("/page", Pages(directory=PAGE)),
        Route("/session", log_in, methods=["POST"]),
        Route("/session", prove),
        Route("/api/panel", panel),
        Route("/api/measure", partial(measure, feed)),
        *Proxy(service).routes(),
        *Retuning(service).routes(),
        *Recordings(service, lambda: feed.run).routes(),
        WebSocketRoute("/live", Live(feed, state).serve),
    ]
    guard = Middleware(Guard, session=session)
    if viewers_token is not None:
        foxglove = Foxglove(feed, viewers_token)
        routes, guard = [*routes, foxglove.route], Middleware(Guard, session=session, is_admitted=foxglove.admits)
    return Starlette(routes=routes, middleware=[guard], lifespan=lifespan)

"""The control API for pages: requests are handed to the control socket as they are, and so are its answers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from rtloop.errors import HostRefusal, UnavailableError
from rtloop.panel.views.service import Service
from rtloop.panel.views.state import NO_ANSWER
from rtloop.panel.web.rates import RateLimit
from rtloop.service.api.lanes import Lane, Lanes, TooManyRequests
from rtloop.service.api.requester import call_at_disconnect
from rtloop.service.api.requests import REQUESTS, ApiRequest
from rtloop.service.client.client import MEASUREMENT_TIMEOUT_S, Disconnector, NoAnswer

TIMEOUT_S = {Lane.ORDINARY: 20.0, Lane.SAFETY: 20.0, Lane.BUILD: 150.0, Lane.MEASUREMENT: MEASUREMENT_TIMEOUT_S}


class Proxy:
    """Hands requests on, each kind in threads of its own: a stop waits for no other request.

    What moves a loop to measure it ends with the page that asked for it; other requests are finished without it.
    """

    def __init__(self, service: Service) -> None:
        self._service, self._lanes = service, Lanes()
        self._rate = RateLimit(per_s=50.0, burst=100)

    def routes(self) -> Sequence[BaseRoute]:
        """Of what is handed on."""
        return [
            Route("/api/openapi.json", self._read),
            *(
                Route(f"/api{entry.path}", self._read if entry.method == "GET" else partial(self._command, entry),
                      methods=[entry.method])
                for entry in REQUESTS
                if entry.page_bytes is not None
            ),
        ]  # fmt: skip

    async def _read(self, request: Request) -> Response:
        return await self._forward(request, Lane.ORDINARY, b"")

    async def _command(self, entry: ApiRequest, request: Request) -> Response:
        lane, max_bytes = entry.lane or Lane.ORDINARY, entry.page_bytes or 0
        if lane is not Lane.SAFETY and not self._rate.allows():
            return JSONResponse({"error": f"more than {self._rate} commands; try again"}, status_code=429)
        try:
            body = await limited_body(request, max_bytes)
        except ClientDisconnect:
            return Response()
        if body is None:
            return JSONResponse({"error": f"request body: more than {max_bytes} bytes"}, status_code=413)
        return await self._forward(request, lane, body)

    async def _forward(self, request: Request, lane: Lane, body: bytes) -> Response:
        resource = request.url.path.removeprefix("/api")
        if request.url.query:
            resource += f"?{request.url.query}"
        exchange, hang_up = self._service.client.exchange, Disconnector()
        arguments = request.method, resource, body, TIMEOUT_S[lane], hang_up
        ends_with_page = lane is Lane.MEASUREMENT
        try:
            async with call_at_disconnect(request, hang_up.disconnect) if ends_with_page else nullcontext():
                code, kind, data = await self._lanes.run(lane, exchange, *arguments)
        except NoAnswer as error:
            return JSONResponse({"error": f"{NO_ANSWER}: {error.reason}"}, status_code=503)
        except (UnavailableError, HostRefusal, TooManyRequests) as error:
            return JSONResponse({"error": str(error)}, status_code=503)
        return Response(data, code, media_type=kind)


async def limited_body(request: Request, max_bytes: int) -> bytes | None:
    """The body; None where it has more than `most` bytes, whose rest is not read. Raises ClientDisconnect."""
    data = bytearray()
    async for part in request.stream():
        data += part
        if len(data) > max_bytes:
            return None
    return bytes(data)


def decode_json(data: bytes) -> object:
    """What JSON says. Raises ValueError for what is none, or too deep."""
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("too many tables and lists within each other") from None

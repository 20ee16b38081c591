"""The control API for pages: requests are handed to the control socket as they are, and so are its answers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import nullcontext

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from rtloop.errors import HostRefusal, UnavailableError
from rtloop.panel.views.service import Service
from rtloop.panel.views.state import NO_ANSWER
from rtloop.panel.web.rates import RateLimit
from rtloop.service.api.bodies import MAX_BODY_BYTES
from rtloop.service.api.lanes import Busy, Lane, Lanes
from rtloop.service.api.requester import at_disconnect
from rtloop.service.client.client import LONGEST_MEASUREMENT_S, HangUp, Unanswered

READ_RESOURCES = ("status", "configuration", "metrics", "openapi.json")
COMMANDS = {
    **dict.fromkeys(("arm", "start", "mode", "reference", "setpoint", "waveform", "lock"), Lane.ORDINARY),
    **dict.fromkeys(("tune", "controller", "preview", "undo"), Lane.BUILD),
    **dict.fromkeys(("stop", "reset"), Lane.SAFETY),
    **dict.fromkeys(("response", "learn"), Lane.MEASUREMENT),
}
SMALL_BYTES = 1 << 16
MAX_LARGE_BYTES = {"waveform": MAX_BODY_BYTES, "learn": MAX_BODY_BYTES}
"""Bodies that may have more than SMALL_BYTES."""
TIMEOUT_S = {Lane.ORDINARY: 20.0, Lane.SAFETY: 20.0, Lane.BUILD: 150.0, Lane.MEASUREMENT: LONGEST_MEASUREMENT_S}


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
            *(Route(f"/api/{name}", self._read) for name in READ_RESOURCES),
            *(Route(f"/api/{name}", self._command, methods=["POST"]) for name in COMMANDS),
            Route("/api/lock", self._command, methods=["DELETE"]),
        ]

    async def _read(self, request: Request) -> Response:
        return await self._forward(request, Lane.ORDINARY, b"")

    async def _command(self, request: Request) -> Response:
        name = request.url.path.rpartition("/")[2]
        lane = COMMANDS[name]
        if lane is not Lane.SAFETY and not self._rate.allows():
            return JSONResponse({"error": f"more than {self._rate} commands; try again"}, status_code=429)
        max_bytes = MAX_LARGE_BYTES.get(name, SMALL_BYTES)
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
        exchange, hang_up = self._service.client.exchange, HangUp()
        arguments = request.method, resource, body, TIMEOUT_S[lane], hang_up
        ends_with_page = lane is Lane.MEASUREMENT
        try:
            async with at_disconnect(request, hang_up.end) if ends_with_page else nullcontext():
                code, kind, data = await self._lanes.run(lane, exchange, *arguments)
        except Unanswered as error:
            return JSONResponse({"error": f"{NO_ANSWER}: {error.reason}"}, status_code=503)
        except (UnavailableError, HostRefusal, Busy) as error:
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

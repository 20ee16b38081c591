"""The control API for pages: requests and responses are forwarded unchanged to and from the control socket."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from rtloop.client.control import (
    BUILD_TIMEOUT_S,
    LONGEST_MEASUREMENT_S,
    TIMEOUT_S,
    Cancellation,
    UnansweredRequest,
)
from rtloop.errors import HostRefusal
from rtloop.panel.service.service import Service
from rtloop.panel.service.state import NO_ANSWER
from rtloop.panel.web.rates import RateLimit
from rtloop.panel.web.responses import Handler, RequestRefused, limited_body, with_error_responses
from rtloop.service.api.lanes import Lane, Lanes
from rtloop.service.api.requester import call_at_disconnect
from rtloop.service.api.requests import REQUESTS, ApiRequest

LONGEST_S = {Lane.BUILD: BUILD_TIMEOUT_S, Lane.MEASUREMENT: LONGEST_MEASUREMENT_S}


class Proxy:
    """Forwards requests, each kind in separate threads, so that a stop waits for no other request.

    A measurement, which moves the loop, ends when its page disconnects; other requests are completed.
    """

    def __init__(self, service: Service) -> None:
        """Prepare the threads, and the limit of commands from all pages: 50 a second on average, 100 at once."""
        self._service, self._lanes = service, Lanes()
        self._rate = RateLimit(per_s=50.0, burst=100)

    def routes(self) -> Sequence[BaseRoute]:
        """Return a route below /api for each request of the control API that pages may send, and /api/openapi.json."""
        entries = [entry for entry in REQUESTS if entry.page_bytes is not None]
        return [
            Route("/api/openapi.json", self._read),
            *(Route(f"/api{entry.path}", self._handler(entry), methods=[entry.method]) for entry in entries),
        ]

    def _handler(self, entry: ApiRequest) -> Handler:
        """Return the handler for the requests that `entry` describes: `_read` for GET, else `_command`."""
        return self._read if entry.method == "GET" else with_error_responses(partial(self._command, entry))

    @with_error_responses
    async def _read(self, request: Request) -> Response:
        """Forward a GET request, without a rate limit, and return its response; errors become JSON responses."""
        return await self._forward(request, Lane.ORDINARY, b"")

    async def _command(self, entry: ApiRequest, request: Request) -> Response:
        """Forward a command and return its response.

        Raises RequestRefused beyond the limits of rate, of all clients together (429; not for a stop or a reset), and
        size (413), and the errors of `_forward`.
        """
        lane = entry.lane or Lane.ORDINARY
        if lane is not Lane.SAFETY and not self._rate.allows():
            raise RequestRefused(429, f"too many commands; allowed: {self._rate}; try again later")
        return await self._forward(request, lane, await limited_body(request, entry.page_bytes or 0))

    async def _forward(self, request: Request, lane: Lane, body: bytes) -> Response:
        """Send a request with `body` to the service in a thread of `lane`; return its response, also a refusal.

        A measurement is cancelled if the page disconnects. Raises RequestRefused (503) for a service that does not
        answer in time or is not trusted, TooManyRequests if too many requests of the lane run or wait.
        """
        resource = request.url.path.removeprefix("/api")
        if request.url.query:
            resource += f"?{request.url.query}"
        exchange, cancellation = self._service.client.exchange, Cancellation()
        arguments = request.method, resource, body, LONGEST_S.get(lane, TIMEOUT_S), cancellation
        ends_with_page = lane is Lane.MEASUREMENT
        try:
            async with call_at_disconnect(request, cancellation.cancel) if ends_with_page else nullcontext():
                code, kind, data = await self._lanes.run(lane, exchange, *arguments)
        except UnansweredRequest as error:
            raise RequestRefused(503, f"{NO_ANSWER}: {error.reason}") from None
        except HostRefusal as error:
            raise RequestRefused(503, str(error)) from None
        return Response(data, code, media_type=kind)

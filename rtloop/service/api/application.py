"""The control API: HTTP on a UNIX socket, described at /openapi.json.

A request that is malformed, too large or outside the envelope changes nothing; its answer is a 4xx with the reason.
Actions run in threads beside the supervisor; nothing here delays a tick.
"""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from rtloop.service.api.bodies import MAX_BODY_BYTES, Body
from rtloop.service.api.description import openapi
from rtloop.service.api.error_responses import error_response, message_response
from rtloop.service.api.lanes import Lane, Lanes
from rtloop.service.api.requester import authorise, watch_client
from rtloop.service.api.requests import REQUESTS, ApiRequest
from rtloop.service.desk import Refusal
from rtloop.service.service import Service
from rtloop.service.status import newest_signals

WATCH_HZ = 20.0
MAX_STREAMS = 16
"""Most WebSockets at a time."""
_REQUESTS = {(request.method, request.path): request for request in REQUESTS}


def application(service: Service) -> Starlette:
    """Return the web application of a service: REQUESTS, /openapi.json, and the WebSockets /watch and /setpoints."""
    lanes, streams = Lanes(), 0

    @asynccontextmanager
    async def stream(socket: WebSocket) -> AsyncIterator[bool]:
        """Accept a WebSocket and yield True; with MAX_STREAMS open, close it and yield False.

        The end of the connection, or bytes in place of a text, ends the work within without an error. At the end the
        WebSocket no longer counts towards MAX_STREAMS.
        """
        nonlocal streams
        if streams >= MAX_STREAMS:
            await socket.close(1013)
            yield False
            return
        streams += 1
        try:
            await socket.accept()
            yield True
        except (WebSocketDisconnect, RuntimeError, OSError, KeyError):  # KeyError: bytes in place of text.
            return
        finally:
            streams -= 1

    async def watch(socket: WebSocket) -> None:
        """Send state, faults, lock holder, progress of a measurement, recovery and newest signals as JSON text,
        WATCH_HZ times a second, until the client disconnects.
        """
        async with stream(socket) as accepted:
            while accepted:
                message = {"state": service.state, "faults": list(service.faults), "lock": service.lock.holder}
                message["measuring"] = service.current_measurement.for_json()
                message["recovery"] = service.recovery.for_json()
                await socket.send_text(json.dumps(message | newest_signals(service)))
                await asyncio.sleep(1 / WATCH_HZ)

    async def setpoints(socket: WebSocket) -> None:
        """Receive setpoints as JSON texts, and send for each one the response to `/setpoint`: its tick or an error.

        The WebSocket stays open after an error.
        """
        setpoint = _REQUESTS["POST", "/setpoint"]
        async with stream(socket) as accepted:
            while accepted:
                response = await _answer_request(service, lanes, socket, setpoint, await socket.receive_text())
                await socket.send_text(bytes(response.body).decode())

    async def answer(request: Request) -> Response:
        """Return the response to an HTTP request of REQUESTS: the result of its action, or {error: message}.

        An empty response if the client disconnects before the end of its body.
        """
        method = "GET" if request.method == "HEAD" else request.method
        try:
            data = await _read_body(request)
        except ClientDisconnect:
            return Response()
        except ValueError as error:
            return message_response(413, str(error))
        return await _answer_request(service, lanes, request, _REQUESTS[method, request.url.path], data)

    async def get_openapi(_: Request) -> Response:
        """Return the response to /openapi.json: the description for the configured axes."""
        return JSONResponse(openapi([axis.name for axis in service.configuration.axes]))

    routes: list[BaseRoute] = [
        Route("/openapi.json", get_openapi),
        WebSocketRoute("/watch", watch),
        WebSocketRoute("/setpoints", setpoints),
    ]
    for path, group in itertools.groupby(REQUESTS, lambda request: request.path):
        routes.append(Route(path, answer, methods=[request.method for request in group]))
    return Starlette(routes=routes)


async def _read_body(request: Request) -> bytes:
    """Return the request's whole body. Raises ValueError for more than MAX_BODY_BYTES, without reading the rest, and
    ClientDisconnect if the client disconnects before the end of the body.
    """
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > MAX_BODY_BYTES:
            raise ValueError(f"request body: too long; allowed: at most {MAX_BODY_BYTES} bytes")
    return data


def _client_watch(lane: Lane | None, connection: HTTPConnection) -> AbstractAsyncContextManager[None]:
    """Return the context in which the action of a request runs. The context of a measurement over HTTP lets
    `is_client_waiting` return whether the client is still connected; any other context has no effect.
    """
    if lane is Lane.MEASUREMENT and isinstance(connection, Request):
        return watch_client(connection)
    return nullcontext()


def _parse_body(request: ApiRequest, connection: HTTPConnection, data: bytes | str) -> Body | None:
    """Return the validated body, or the query of a GET request; None for a request without a body.

    Unknown names in a query are ignored; an empty optional body counts as {}. Raises ValidationError for a body that is
    not JSON, for unknown fields of a body, and for missing or invalid values.
    """
    if request.body is None:
        return None
    if request.method == "GET":
        query = connection.query_params
        return request.body.model_validate({name: query[name] for name in request.body.model_fields if name in query})
    return request.body.model_validate_json(data or b"{}" if request.body_optional else data)


async def _answer_request(
    service: Service, lanes: Lanes, connection: HTTPConnection, request: ApiRequest, data: bytes | str
) -> Response:
    """Validate a request and run its action for its requester; `data` is the body as received. Returns the response:
    the action's result, {error: message} for an error, and 503 for a request that the end of the service refuses.

    Raises exceptions that `error_response` does not know.
    """
    try:
        body = _parse_body(request, connection, data)
        with authorise(service, connection, request, body):
            if request.lane is None:
                content = request.action(service, body)
            else:
                async with _client_watch(request.lane, connection):
                    content = await lanes.run(request.lane, request.action, service, body)
        if isinstance(content, str):
            return PlainTextResponse(content, media_type=request.media_type)
        return JSONResponse(content)
    except asyncio.CancelledError:  # The server ends while the client still waits.
        return _ending_response(request)
    except Exception as error:
        return _ending_response(request) if isinstance(error, Refusal) and service.is_ending else error_response(error)


def _ending_response(request: ApiRequest) -> Response:
    """Return the response, 503, to a request that the end of the service leaves without its result."""
    return message_response(503, f"{request.name}: the service is ending and takes no more requests")

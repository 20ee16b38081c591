"""The control API: HTTP on a UNIX socket, described by itself at /openapi.json.

A request that is malformed, too large or outside the envelope gets a 4xx that says why, and changes nothing. Handlers
run in threads beside the supervisor; nothing here is in the path of a tick.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from drivers.errors import DriverError
from rtloop.config import ModeName, describe
from rtloop.engine.commands import QueueFull
from rtloop.errors import ConfigError, RtloopError
from rtloop.service.desk import Refused
from rtloop.service.metrics import metrics_text
from rtloop.service.service import Service
from rtloop.service.status import newest_signals, status

MAX_BODY_BYTES = 4 << 20
WATCH_HZ = 20.0


class Body(BaseModel):
    """Base of request bodies."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class ModeBody(Body):
    """A mode for all axes."""

    mode: ModeName


class ReferenceBody(Body):
    """A reference as in [axis.reference]."""

    axis: str
    reference: dict[str, Any]


class SetpointBody(Body):
    """A constant reference, µm (V in raw mode)."""

    axis: str
    value: float


class WaveformBody(Body):
    """Samples, `hold_ticks` ticks each."""

    axis: str
    samples: list[float] = Field(min_length=1)
    hold_ticks: int = Field(default=1, ge=1)
    repeat: bool = False


class TuneBody(Body):
    """Keys of [axis.SECTION] to change."""

    axis: str
    section: str
    values: dict[str, Any] = Field(min_length=1)


class ControllerBody(Body):
    """A whole [axis.controller]."""

    axis: str
    controller: dict[str, Any]


Action = Callable[[Service, Any], dict[str, Any]]


def _tick(tick: int) -> dict[str, Any]:
    return {"tick": tick}


def _live(service: Service) -> Any:
    if service.live is None:
        raise Refused(f"no loop is running: the service is {service.state}")
    return service.live


def _arm(service: Service, _: Any) -> dict[str, Any]:
    service.arm()
    return {}


ACTIONS: dict[str, tuple[type[Body] | None, str, Action]] = {
    "/arm": (None, "Allow the outputs to be driven.", _arm),
    "/start": (None, "Set the configured mode.", lambda service, _: _tick(service.start())),
    "/stop": (None, "Ramp the outputs to safe.", lambda service, _: _tick(service.stop())),
    "/reset": (None, "Forget latched trips; the outputs stay off.", lambda service, _: _tick(service.reset())),
    "/reload": (None, "Read the configuration again.", lambda service, _: service.reload_now()),
    "/mode": (ModeBody, "Change the mode bumplessly.", lambda service, body: _tick(service.set_mode(body.mode))),
    "/reference": (ReferenceBody, "Change the reference of an axis.",
                   lambda service, body: _tick(_live(service).set_reference(body.axis, body.reference))),
    "/setpoint": (SetpointBody, "Hold the reference of an axis at a value.",
                  lambda service, body: _tick(_setpoint(service, body))),
    "/waveform": (WaveformBody, "Play samples on an axis.",
                  lambda service, body: _tick(_live(service).set_waveform(body.axis, body.samples, body.hold_ticks,
                                                                          body.repeat))),
    "/tune": (TuneBody, "Change keys of controller, limits, interlocks, prefilter or model.",
              lambda service, body: _tick(_live(service).tune(body.axis, body.section, body.values))),
    "/controller": (ControllerBody, "Verify another controller and swap it in bumplessly.",
                    lambda service, body: _tick(_live(service).load_controller(body.axis, body.controller))),
}  # fmt: skip
"""Path → body, what it does, how. All are POST; a command's answer is the tick at which it took effect."""


def _setpoint(service: Service, body: SetpointBody) -> int:
    return _live(service).set_reference(body.axis, {"kind": "hold", "value": body.value})


def application(service: Service) -> Starlette:
    """The API of a service."""

    async def get_status(_: Request) -> Response:
        return JSONResponse(status(service))

    async def get_metrics(_: Request) -> Response:
        return PlainTextResponse(metrics_text(service), media_type="text/plain; version=0.0.4")

    async def get_openapi(_: Request) -> Response:
        return JSONResponse(openapi())

    async def watch(socket: WebSocket) -> None:
        await socket.accept()
        try:
            while True:
                await socket.send_text(json.dumps({"state": service.state} | newest_signals(service)))
                await asyncio.sleep(1 / WATCH_HZ)
        except (WebSocketDisconnect, RuntimeError, OSError):
            return

    async def setpoints(socket: WebSocket) -> None:
        """A stream of setpoints, each answered by its tick or an error."""
        await socket.accept()
        try:
            while True:
                answer = await _answer(service, SetpointBody, ACTIONS["/setpoint"][2], await socket.receive_text())
                await socket.send_text(bytes(answer.body).decode())
        except (WebSocketDisconnect, RuntimeError, OSError, KeyError):  # the last for bytes instead of text
            return

    def post(body: type[Body] | None, action: Action) -> Callable[[Request], Any]:
        async def handler(request: Request) -> Response:
            try:
                data = await _read(request)
            except ValueError as error:
                return _error(413, str(error))
            return await _answer(service, body, action, data)

        return handler

    routes: list[Any] = [
        Route("/status", get_status),
        Route("/metrics", get_metrics),
        Route("/openapi.json", get_openapi),
        WebSocketRoute("/watch", watch),
        WebSocketRoute("/setpoints", setpoints),
    ]
    routes += [Route(path, post(body, action), methods=["POST"]) for path, (body, _, action) in ACTIONS.items()]
    return Starlette(routes=routes)


async def _read(request: Request) -> bytes:
    """The body. Raises ValueError where it is larger than allowed, without reading the rest."""
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > MAX_BODY_BYTES:
            raise ValueError(f"request body: more than {MAX_BODY_BYTES} bytes")
    return data


async def _answer(service: Service, body: type[Body] | None, action: Action, data: bytes | str) -> Response:
    """Validate, act in a thread, and answer; errors become 4xx that say why."""
    try:
        wanted = None if body is None else body.model_validate_json(data)
        return JSONResponse(await run_in_threadpool(action, service, wanted))
    except ValidationError as error:
        return _error(422, "; ".join(describe(error, "", {})))
    except ConfigError as error:
        return _error(422, "; ".join(error.faults))
    except (Refused, QueueFull) as error:
        return _error(409, str(error))
    except (RtloopError, DriverError) as error:
        return _error(409, str(error))


def _error(code: int, message: str) -> JSONResponse:
    return JSONResponse({"error": message}, status_code=code)


def openapi() -> dict[str, Any]:
    """An OpenAPI 3.1 description of the API."""
    paths: dict[str, Any] = {
        "/status": {"get": {"summary": "State, rate, faults, newest signals."}},
        "/metrics": {"get": {"summary": "Prometheus text."}},
    }
    answers = {"200": {"description": "done; a command's `tick` is when it took effect"},
               "409": {"description": "refused in this state"}, "413": {"description": "too large"},
               "422": {"description": "malformed, or outside the envelope"}}  # fmt: skip
    for path, (body, summary, _) in ACTIONS.items():
        operation: dict[str, Any] = {"summary": summary, "responses": answers}
        if body is not None:
            schema = body.model_json_schema()
            operation["requestBody"] = {"required": True, "content": {"application/json": {"schema": schema}}}
        paths[path] = {"post": operation}
    from rtloop import __version__

    return {"openapi": "3.1.0", "info": {"title": "rtloop control API", "version": __version__}, "paths": paths}

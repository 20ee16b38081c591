"""The control API: HTTP on a UNIX socket, described by itself at /openapi.json.

A request that is malformed, too large or outside the envelope gets a 4xx that says why, and changes nothing. Handlers
run in threads beside the supervisor; nothing here is in the path of a tick.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, nullcontext
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from rtloop.configuration.axis import TableOptions
from rtloop.configuration.file import describe
from rtloop.configuration.references import read_samples
from rtloop.errors import ConfigError
from rtloop.recording.file.topics.events import OPERATOR
from rtloop.service.api.bodies import (
    MAX_BODY_BYTES,
    Body,
    ControllerBody,
    LearnBody,
    LockBody,
    ModeBody,
    ReferenceBody,
    ResponseBody,
    SetpointBody,
    TuneBody,
    UndoBody,
    WaveformBody,
)
from rtloop.service.api.error_responses import refusal, refused
from rtloop.service.api.lanes import Lane, Lanes
from rtloop.service.api.metrics import metrics_text
from rtloop.service.api.requester import asking, lock, watching_client
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Refused
from rtloop.service.measuring.learning import learn
from rtloop.service.measuring.measurement import Asked, Results, measure
from rtloop.service.service import Service, State
from rtloop.service.status import newest_signals, running_configuration, status
from rtloop.supervision.supervisor import Supervisor

WATCH_HZ = 20.0
MAX_STREAMS = 16
"""WebSockets at a time."""

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
    "/stop": (None, "Ramp the outputs to safe; waits for no other request.", lambda service, _: _tick(service.stop())),
    "/reset": (None, "Forget latched trips; the outputs stay off.", lambda service, _: _tick(service.reset())),
    "/reload": (None, "Read the configuration again.", lambda service, _: service.reload_now()),
    "/mode": (ModeBody, "Change the mode bumplessly.", lambda service, body: _tick(service.set_mode(body.mode))),
    "/reference": (ReferenceBody, "Change the reference of an axis.",
                   lambda service, body: _tick(_reference(service, body))),
    "/setpoint": (SetpointBody, "Hold the reference of an axis at a value.",
                  lambda service, body: _tick(_setpoint(service, body))),
    "/waveform": (WaveformBody, "Play samples on an axis.",
                  lambda service, body: _tick(_live(service).references.set_waveform(
                      body.axis, body.columns, body.hold_ticks, body.repeat))),
    "/response": (ResponseBody, "Measure the response of the closed loop about the reference that is held.",
                  lambda service, body: _response(service, body)),
    "/learn": (LearnBody, "Play a period and learn it; it goes on playing unless `keep` is false.",
               lambda service, body: _learn(service, body)),
    "/tune": (TuneBody, "Change keys of controller, limits, interlocks, prefilter or model.",
              lambda service, body: _tick(_live(service).tune(body.axis, body.section, body.values))),
    "/controller": (ControllerBody, "Verify another controller and swap it in bumplessly.",
                    lambda service, body: _tick(_live(service).load_controller(body.axis, body.controller))),
    "/preview": (TuneBody, "What `/tune` would make of margins and step; changes nothing.",
                 lambda service, body: _live(service).preview(body.axis, body.section, body.values)),
    "/undo": (UndoBody, "Go back to before the last change of an axis.", lambda service, body: _undo(service, body)),
}  # fmt: skip
"""Path → body, what it does, how. All are POST; a command's answer is the tick at which it took effect."""
LANES = {"/response": Lane.MEASUREMENT, "/learn": Lane.MEASUREMENT, "/stop": Lane.SAFETY, "/reset": Lane.SAFETY,
         **dict.fromkeys(("/tune", "/controller", "/preview", "/undo", "/reload"), Lane.BUILD)}  # fmt: skip
"""The rest is ordinary."""


def _reference(service: Service, body: ReferenceBody) -> int:
    """Another generator; a table is read here, for whoever asks may not read what the service may."""
    live = _live(service)
    if body.reference.get("kind") != "table":
        return live.references.set(body.axis, body.reference)
    try:
        table = TableOptions.model_validate(body.reference)
        samples = read_samples(Path(table.file), folder=service.configuration.folder)
    except ValidationError as error:
        raise ConfigError("reference", describe(error, "reference", body.reference)) from None
    except ValueError as error:
        raise ConfigError("reference", [f"reference.{error}"]) from None
    return live.references.set_waveform(body.axis, samples, table.hold_ticks, table.repeat)


def _response(service: Service, body: ResponseBody) -> dict[str, Any]:
    """Figures and lines; the figures stay with the service."""
    with service.underway.begin("response", body.axis):
        measurement = measure(*_running(service, "response"), body.axis, Asked(**body.model_dump(exclude={"axis"})))
    service.measured.setdefault(body.axis, Results()).note(measurement)
    return measurement.for_json()


def _undo(service: Service, body: UndoBody) -> dict[str, Any]:
    """The tick, and what was undone."""
    tick, change_text = _live(service).undo(body.axis)
    return _tick(tick) | {"undone": change_text}


def _learn(service: Service, body: LearnBody) -> dict[str, Any]:
    """Every cycle, and the best table, which is played now if it is to be kept."""
    running_loop, current_measurement = _running(service, "learn"), service.underway
    with current_measurement.begin("learn", body.axis, body.cycles):
        return learn(*running_loop, body.axis, body.asked, current_measurement.add_cycle).for_json()


def _running(service: Service, doing: str) -> tuple[Supervisor, LiveLaw]:
    live, supervisor = _live(service), service.supervisor
    if supervisor is None or service.state is not State.RUNNING:
        raise Refused(f"{doing}: the service is {service.state}; a loop that runs is needed")
    return supervisor, live


def _setpoint(service: Service, body: SetpointBody) -> int:
    return _live(service).references.set(body.axis, {"kind": "hold", "value": body.value})


def application(service: Service) -> Starlette:
    """The API of a service."""
    lanes, streams = Lanes(), 0

    @asynccontextmanager
    async def stream(socket: WebSocket) -> AsyncIterator[bool]:
        """Accept one of MAX_STREAMS; False, and refused, where there are as many. Its end is no error."""
        nonlocal streams
        if streams >= MAX_STREAMS:
            await socket.close(1013)
            yield False
            return
        streams += 1
        try:
            await socket.accept()
            yield True
        except (WebSocketDisconnect, RuntimeError, OSError, KeyError):  # the last for bytes instead of text
            return
        finally:
            streams -= 1

    async def get_status(_: Request) -> Response:
        return JSONResponse(status(service))

    async def get_configuration(_: Request) -> Response:
        try:
            return JSONResponse(running_configuration(service))
        except Refused as error:
            return refusal(error)

    async def get_asked_by(request: Request) -> Response:
        """Name and change of a command's identity, as its event has it."""
        supervisor, live, identity = service.supervisor, service.live, request.query_params.get("identity", "")
        if not (identity.isascii() and identity.isdigit() and len(identity) < 19):
            return refused(422, "identity: that of a command, a number, is needed")
        name = None if supervisor is None else supervisor.names.requester(int(identity))
        return JSONResponse({"name": name, "change": None if live is None else live.change_of(int(identity))})

    async def get_metrics(_: Request) -> Response:
        return PlainTextResponse(metrics_text(service), media_type="text/plain; version=0.0.4")

    async def get_openapi(_: Request) -> Response:
        return JSONResponse(openapi())

    async def watch(socket: WebSocket) -> None:
        async with stream(socket) as accepted:
            while accepted:
                message = {"state": service.state, "faults": list(service.faults), "lock": service.lock.held}
                message["measuring"] = service.underway.for_json()
                await socket.send_text(json.dumps(message | newest_signals(service)))
                await asyncio.sleep(1 / WATCH_HZ)

    async def setpoints(socket: WebSocket) -> None:
        """A stream of setpoints, each answered by its tick or an error."""
        async with stream(socket) as accepted:
            while accepted:
                response = await _answer(service, lanes, socket, "/setpoint", await socket.receive_text())
                await socket.send_text(bytes(response.body).decode())

    async def post(request: Request) -> Response:
        try:
            data = await _read(request)
        except ClientDisconnect:
            return Response()
        except ValueError as error:
            return refused(413, str(error))
        if request.url.path == "/lock":
            return lock(service, request, data)
        return await _answer(service, lanes, request, request.url.path, data)

    async def delete_lock(request: Request) -> Response:
        return lock(service, request, None)

    routes: list[Any] = [
        Route("/status", get_status),
        Route("/configuration", get_configuration),
        Route("/asked_by", get_asked_by),
        Route("/metrics", get_metrics),
        Route("/openapi.json", get_openapi),
        WebSocketRoute("/watch", watch),
        WebSocketRoute("/setpoints", setpoints),
    ]
    routes += [Route(path, post, methods=["POST"]) for path in (*ACTIONS, "/lock")]
    routes += [Route("/lock", delete_lock, methods=["DELETE"])]
    return Starlette(routes=routes)


async def _read(request: Request) -> bytes:
    """The body. Raises ValueError where it is larger than allowed, without reading the rest."""
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > MAX_BODY_BYTES:
            raise ValueError(f"request body: more than {MAX_BODY_BYTES} bytes")
    return data


def _watching(lane: Lane, connection: HTTPConnection) -> AbstractAsyncContextManager[None]:
    """Watch the client of a measurement, which ends with it; other requests are finished without their client."""
    if lane is Lane.MEASUREMENT and isinstance(connection, Request):
        return watching_client(connection)
    return nullcontext()


async def _answer(service: Service, lanes: Lanes, connection: HTTPConnection, path: str, data: bytes | str) -> Response:
    """Validate, act in a thread, and answer."""
    body_type, _, action = ACTIONS[path]
    lane = LANES.get(path, Lane.ORDINARY)
    try:
        request_body = None if body_type is None else body_type.model_validate_json(data)
        with asking(service, connection, path, request_body):
            async with _watching(lane, connection):
                return JSONResponse(await lanes.run(lane, action, service, request_body))
    except asyncio.CancelledError:  # whoever still waits as the server comes to its end
        return refused(503, f"{path.removeprefix('/')}: the service ends")
    except Exception as error:
        return refusal(error)


def openapi() -> dict[str, Any]:
    """An OpenAPI 3.1 description of the API."""
    paths: dict[str, Any] = {
        "/status": {"get": {"summary": "State, rate, faults, newest signals."}},
        "/configuration": {"get": {"summary": "The configuration as it runs, with what was tuned since; what a record "
                                              "holds, and where shared block and recordings lie."}},
        "/asked_by": {"get": {"summary": "Who asked for a command, by the `identity` of its event, and the change that "
                                         "it made of a law; null: unknown."}},
        "/metrics": {"get": {"summary": "Prometheus text."}},
    }  # fmt: skip
    responses = {"200": {"description": "done; a command's `tick` is when it took effect"},
               "409": {"description": "refused in this state, or while somebody else drives, and withdrawn"},
               "413": {"description": "too large"},
               "422": {"description": "malformed, or outside the envelope"},
               "503": {"description": "too many wait, or it takes too long"},
               "504": {"description": "taken by a loop that stands still: takes effect if that goes on"}}  # fmt: skip
    for path, (body_type, summary, _) in ACTIONS.items():
        paths[path] = {"post": _operation(summary, responses, body_type)}
    paths["/lock"] = {
        "post": _operation(
            "Take the lock, or break it open by the emergency key.", responses, LockBody, required=False
        ),
        "delete": _operation("Release the lock.", responses, None),
    }
    from rtloop import __version__

    return {"openapi": "3.1.0", "info": {"title": "rtloop control API", "version": __version__}, "paths": paths}


def _operation(summary: str, answers: Any, body: type[Body] | None, required: bool = True) -> dict[str, Any]:
    name_parameter = {
        "name": "as",
        "in": "query",
        "description": "who drives",
        "schema": {"type": "string", "default": OPERATOR},
    }
    operation: dict[str, Any] = {"summary": summary, "parameters": [name_parameter], "responses": answers}
    if body is not None:
        content = {"application/json": {"schema": body.model_json_schema()}}
        operation["requestBody"] = {"required": required, "content": content}
    return operation

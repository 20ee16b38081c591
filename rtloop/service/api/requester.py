"""Who asks, `?as=NAME`, and whether they may while somebody else drives."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractContextManager, asynccontextmanager, nullcontext
from typing import Any
from urllib.parse import parse_qs

from starlette.requests import HTTPConnection, Request
from starlette.responses import JSONResponse, Response

from rtloop.errors import ConfigError
from rtloop.recording.file.topics.events import OPERATOR, name_problem
from rtloop.service.api.bodies import LockBody
from rtloop.service.api.error_responses import refusal
from rtloop.service.desk import NOBODY, Asker, asked_by
from rtloop.service.measuring.client_presence import on_behalf_of
from rtloop.service.service import Service


def asker_name(connection: HTTPConnection) -> str:
    """Return the name in `?as=NAME`, OPERATOR where there is none. Raises ConfigError for what is no name."""
    try:
        text = connection.scope.get("query_string", b"").decode("ascii")
        query = parse_qs(text, keep_blank_values=True, errors="strict")
    except ValueError:
        raise ConfigError("request", ["as: its bytes are no text; UTF-8 is needed"]) from None
    names = query.get("as", [OPERATOR])
    if len(names) > 1:
        raise ConfigError("request", [f"as: {len(names)} names; one is allowed"])
    if fault := name_problem(names[0]):
        raise ConfigError("request", [f"as: {fault}"])
    return names[0]


def asking(service: Service, connection: HTTPConnection, path: str, body: Any) -> AbstractContextManager[None]:
    """By whom, and with the lock: but stop waits for nobody's, and no name holds it up. Raises ConfigError, Refused.

    What changes nothing needs neither.
    """
    if path == "/preview":
        return nullcontext()
    if path != "/stop" and not (path == "/mode" and body.mode == "off"):
        return service.lock.driving(asker_name(connection))
    try:
        return asked_by(Asker(asker_name(connection)))
    except ConfigError:
        return asked_by(NOBODY)


@asynccontextmanager
async def watching_client(request: Request) -> AsyncIterator[None]:
    """Work on a request whose body was read; the work in between can ask whether the client's connection stands."""
    disconnect_event = threading.Event()
    async with at_disconnect(request, disconnect_event.set):
        with on_behalf_of(lambda: not disconnect_event.is_set()):
            yield


@asynccontextmanager
async def at_disconnect(request: Request, action: Callable[[], object]) -> AsyncIterator[None]:
    """Call `action` where the connection of a request, whose body was read, ends before the work in between."""

    async def watch() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass
        action()

    watcher = asyncio.create_task(watch())
    try:
        yield
    finally:
        watcher.cancel()


def lock(service: Service, connection: HTTPConnection, data: bytes | None) -> Response:
    """Take the lock, break it open where there is a key, or release it where there is no body."""
    try:
        name = asker_name(connection)
        if data is None:
            service.lock.release(name)
            return JSONResponse({})
        key = LockBody.model_validate_json(data or b"{}").emergency_key
        if key is None:
            service.lock.take(name)
        else:
            service.lock.break_open(name, key, service.configuration.service.emergency_key_sha256)
        return JSONResponse(service.lock.held)
    except Exception as error:
        return refusal(error)

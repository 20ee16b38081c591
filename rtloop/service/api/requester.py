"""The requester of a request, `?as=NAME`, its permission, and its connection."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractContextManager, asynccontextmanager, nullcontext
from urllib.parse import parse_qs

from starlette.requests import HTTPConnection, Request

from rtloop.errors import ConfigError
from rtloop.foundation import timing
from rtloop.recording.file.topics.events import OPERATOR, name_problem
from rtloop.service.api.bodies import Body
from rtloop.service.api.requests import ApiRequest, Sender
from rtloop.service.desk import UNNAMED_REQUESTER, Requester, use_requester
from rtloop.service.measuring.client_presence import bind_client
from rtloop.service.service import Service


def requester_name(connection: HTTPConnection) -> str:
    """Return the name in `?as=NAME`, OPERATOR without one. Raises ConfigError for an invalid name and for several."""
    try:
        text = connection.scope.get("query_string", b"").decode("ascii")
        query = parse_qs(text, keep_blank_values=True, errors="strict")
    except ValueError:
        raise ConfigError("request", ["as: the name is not valid text; allowed: UTF-8, percent-encoded"]) from None
    names = query.get("as", [OPERATOR])
    if len(names) > 1:
        raise ConfigError("request", [f"as: {len(names)} names; allowed: 1"])
    if fault := name_problem(names[0]):
        raise ConfigError("request", [f"as: {fault}"])
    return names[0]


def authorise(
    service: Service, connection: HTTPConnection, request: ApiRequest, body: Body | None
) -> AbstractContextManager[None]:
    """Return a context in which the action of a request runs under its requester's name, as `request.sender` states.

    The context of LOCK_HOLDER takes or renews the lock; entering it raises Refusal while another name holds the lock.
    The context of ANYONE has no name. A stop needs no lock; without a valid name it runs as UNNAMED_REQUESTER. The call
    raises ConfigError for an invalid name that the request needs.
    """
    if request.sender is Sender.STOPPER or (body is not None and body.is_stop):
        try:
            return use_requester(Requester(requester_name(connection)))
        except ConfigError:
            return use_requester(UNNAMED_REQUESTER)
    if request.sender is Sender.LOCK_HOLDER:
        return service.lock.hold(requester_name(connection))
    if request.sender is Sender.NAMED:
        return use_requester(Requester(requester_name(connection)))
    return nullcontext()


@asynccontextmanager
async def watch_client(request: Request) -> AsyncIterator[None]:
    """Make `is_client_waiting` return, during the work within, whether the client of `request` is still connected.

    The request's body must have been read.
    """
    disconnect_event = timing.event()
    async with call_at_disconnect(request, disconnect_event.set):
        with bind_client(lambda: not disconnect_event.is_set()):
            yield


@asynccontextmanager
async def call_at_disconnect(request: Request, action: Callable[[], object]) -> AsyncIterator[None]:
    """Call `action` if the connection of a request ends before the work within ends.

    The request's body must have been read.
    """

    async def watch() -> None:
        """Wait for the end of the connection, then call `action`."""
        while (await request.receive())["type"] != "http.disconnect":
            pass
        action()

    watcher = asyncio.create_task(watch())
    try:
        yield
    finally:
        watcher.cancel()

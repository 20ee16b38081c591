"""Responses of the panel to errors, and request bodies of bounded size."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from functools import wraps

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from rtloop.errors import ConfigError, RtloopError, UnavailableError
from rtloop.service.api.lanes import TooManyRequests

Handler = Callable[..., Awaitable[Response]]


class RequestRefused(Exception):
    """A refusal of a request: HTTP status `code`, and the reason."""

    def __init__(self, code: int, error: str) -> None:
        """Store the HTTP status and the reason."""
        super().__init__(error)
        self.code = code


class PlainJSONResponse(JSONResponse):
    """JSON in ASCII, in which any file name can be sent, also one that is not UTF-8."""

    def render(self, content: object) -> bytes:
        """Return `content` as JSON in ASCII. Raises ValueError for NaN and infinity."""
        return json.dumps(content, allow_nan=False).encode("ascii")


def with_error_responses(handler: Handler) -> Handler:
    """Wrap a handler so that its errors become JSON responses {error}, with the HTTP status of `status_code`.

    The errors are RequestRefused, TooManyRequests, RtloopError and ValueError; any other is raised. A client that
    disconnected gets an empty response.
    """

    @wraps(handler)
    async def respond(*arguments: object, **options: object) -> Response:
        """Return the handler's response, or a response that states its error."""
        try:
            return await handler(*arguments, **options)
        except ClientDisconnect:
            return Response()
        except ConfigError as error:
            return PlainJSONResponse({"error": "; ".join(error.faults)}, 422)
        except (RequestRefused, TooManyRequests, RtloopError, ValueError) as error:
            return PlainJSONResponse({"error": str(error)}, status_code(error))

    return respond


def status_code(error: Exception) -> int:
    """Return the HTTP status for an error: a RequestRefused's code, 503 for an absent or busy service, else 422."""
    if isinstance(error, RequestRefused):
        return error.code
    return 503 if isinstance(error, TooManyRequests | UnavailableError) else 422


async def limited_body(request: Request, max_bytes: int) -> bytes:
    """Return the body of a request.

    Raises RequestRefused (413) above `max_bytes`, without reading the rest, and ClientDisconnect if the client leaves.
    """
    data = bytearray()
    async for part in request.stream():
        data += part
        if len(data) > max_bytes:
            raise RequestRefused(413, f"request body: too long; allowed: at most {max_bytes} bytes")
    return bytes(data)


def decode_json(data: bytes) -> object:
    """Return the value in JSON bytes, in which NaN and Infinity are allowed.

    Raises ValueError for invalid or too deeply nested JSON.
    """
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("request body: too many nested tables and lists") from None

"""Responses to failed requests: a status code and {error: message}."""

from __future__ import annotations

from pydantic import ValidationError
from starlette.responses import JSONResponse, Response

from rtloop.configuration.file import describe
from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, RtloopError, UnavailableError
from rtloop.service.api.lanes import TooManyRequests
from rtloop.service.desk import UnconfirmedCommand


def error_response(error: Exception) -> Response:
    """Return {error: message} as a response, with the status of the error's class.

    422 for ValidationError and ConfigError, 503 for a full lane (TooManyRequests) and UnavailableError, 504 for
    UnconfirmedCommand, 409 for any other RtloopError and DriverError. Raises any other `error` itself.
    """
    match error:
        case ValidationError():
            return message_response(422, "; ".join(describe(error, "", None)))
        case ConfigError():
            return message_response(422, "; ".join(error.faults))
        case TooManyRequests() | UnavailableError():
            return message_response(503, str(error))
        case UnconfirmedCommand():
            return message_response(504, str(error))
        case RtloopError() | DriverError():
            return message_response(409, str(error))
    raise error


def message_response(code: int, message: str) -> JSONResponse:
    """Return the response {error: message} with status `code`."""
    return JSONResponse({"error": message}, status_code=code)

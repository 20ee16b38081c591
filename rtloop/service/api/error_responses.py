"""What an error becomes: a status, and `error` with the words that say why."""

from __future__ import annotations

from pydantic import ValidationError
from starlette.responses import JSONResponse, Response

from rtloop.configuration.file import describe
from rtloop.drivers.errors import DriverError
from rtloop.engine.commands import QueueFull
from rtloop.errors import ConfigError, RtloopError, UnavailableError
from rtloop.service.api.lanes import Busy
from rtloop.service.desk import Taken


def refusal(error: Exception) -> Response:
    """A 4xx that says why, 503 where too many wait. Raises what is none of these."""
    match error:
        case ValidationError():
            return refused(422, "; ".join(describe(error, "", None)))
        case ConfigError():
            return refused(422, "; ".join(error.faults))
        case Busy() | UnavailableError():
            return refused(503, str(error))
        case Taken():
            return refused(504, str(error))
        case QueueFull() | RtloopError() | DriverError():
            return refused(409, str(error))
    raise error


def refused(code: int, message: str) -> JSONResponse:
    """The answer with this status."""
    return JSONResponse({"error": message}, status_code=code)

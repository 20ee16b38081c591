"""`/api/retune` and `/api/swap`: `rtloop ctl retune` for pages, in a process beside the panel.

A page first gets a proposal: the resonance was measured, and nothing is changed. Its consent is a second request, with
the proposal. The measurement ends with the page that asked for it; a swap, once begun, is finished without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import anyio
from pydantic import Field
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from rtloop.errors import ConfigError, LoopFault, UnavailableError
from rtloop.panel.shelf.process_runner import ProcessFailed, ProcessRunner, TooManyRequests
from rtloop.panel.views.service import Service
from rtloop.panel.web.proxy import limited_body
from rtloop.panel.web.requests import validate_request
from rtloop.service.api.bodies import Body, Name
from rtloop.service.api.requester import call_at_disconnect, requester_name
from rtloop.service.api.requests import SMALL_BYTES

LONGEST_S = 600.0
"""The search for new taps may take minutes."""
STATUS_BY_EXIT_CODE: dict[int | None, int] = {LoopFault.exit_code: 409, UnavailableError.exit_code: 503}
"""Status of an answer by the exit code of the command; 422 for the rest."""
Row = Annotated[list[float], Field(min_length=1, max_length=1000)]


class RetuneBody(Body):
    """The axis, and options of `rtloop ctl retune`; the command has its defaults for those that are missing."""

    axis: Name
    amplitude_um: float | None = Field(default=None, gt=0)
    bound_percent: float | None = Field(default=None, gt=0, le=50)
    within_percent: float | None = Field(default=None, ge=0, le=50)


class TapsBody(Body):
    """Both rows of taps."""

    taps: Row
    command_taps: Row


class SwapBody(Body):
    """The part of a proposal that is swapped in, and that which was compared with it."""

    axis: Name
    replaces: TapsBody
    prefilter: TapsBody


class Retuning:
    """Runs one `rtloop ctl retune` at a time."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._processes = ProcessRunner(max_running=1, max_pending=1, timeout_s=LONGEST_S)

    def routes(self) -> Sequence[BaseRoute]:
        """The two routes."""
        return [
            Route("/api/retune", self._retune, methods=["POST"]),
            Route("/api/swap", self._swap, methods=["POST"]),
        ]

    async def _retune(self, request: Request) -> Response:
        return await self._respond(request, RetuneBody, ends_with_page=True)

    async def _swap(self, request: Request) -> Response:
        return await self._respond(request, SwapBody, ends_with_page=False)

    async def _respond(self, request: Request, model: type[RetuneBody | SwapBody], ends_with_page: bool) -> Response:
        """The command's JSON, or its error with the status that suits it."""
        try:
            data = await limited_body(request, SMALL_BYTES)
            if data is None:
                return _error_response(413, f"request body: more than {SMALL_BYTES} bytes")
            body, name = validate_request(model, data), requester_name(request)
            if not ends_with_page:
                return JSONResponse(await self._run_command(name, body))
            with anyio.CancelScope() as scope:
                async with call_at_disconnect(request, scope.cancel):
                    return JSONResponse(await self._run_command(name, body))
            return Response()
        except ClientDisconnect:
            return Response()
        except ConfigError as error:
            return _error_response(422, "; ".join(error.faults))
        except ValueError as error:
            return _error_response(422, str(error))
        except TooManyRequests as error:
            return _error_response(503, str(error))
        except ProcessFailed as error:
            return _error_response(STATUS_BY_EXIT_CODE.get(error.code, 422), str(error))

    async def _run_command(self, name: str, body: RetuneBody | SwapBody) -> dict[str, Any]:
        ctl = ["ctl", f"--socket={self._service.client.path}", f"--as={name}", "retune", "--json"]
        if isinstance(body, SwapBody):
            return await self._processes.run("rtloop", *ctl, "--swap=-", "--", body.axis, stdin=body.model_dump_json())
        options = body.model_dump(exclude={"axis"}, exclude_none=True)
        options_text = [f"--{key.replace('_', '-')}={value!r}" for key, value in options.items()]
        return await self._processes.run("rtloop", *ctl, *options_text, "--", body.axis)


def _error_response(code: int, error: str) -> Response:
    return JSONResponse({"error": error}, status_code=code)

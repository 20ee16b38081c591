"""`/api/retune` and `/api/swap`: `rtloop ctl retune` for pages, in a process beside the panel.

A page first gets a proposal of new taps, from a measurement of the resonance; the loop keeps its taps. The user's
consent is a second request that contains the proposal. A measurement ends when its page disconnects; a swap, once
begun, is completed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Annotated

import anyio
from pydantic import Field
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from rtloop.errors import LoopFault, UnavailableError
from rtloop.panel.recordings.process_runner import ProcessFailed, ProcessRunner
from rtloop.panel.service.service import Service
from rtloop.panel.web.requests import validate_request
from rtloop.panel.web.responses import RequestRefused, limited_body, with_error_responses
from rtloop.service.api.bodies import Body, Name
from rtloop.service.api.requester import call_at_disconnect, requester_name
from rtloop.service.api.requests import SMALL_BYTES

LONGEST_S = 600.0
"""Time limit of one command; the search for new taps may take minutes."""
STATUS_BY_EXIT_CODE: dict[int | None, int] = {LoopFault.exit_code: 409, UnavailableError.exit_code: 503}
"""HTTP status by the exit code of the command; 422 for all others."""
Row = Annotated[list[float], Field(min_length=1, max_length=1000)]


class RetuneBody(Body):
    """Body of `/api/retune`: the axis, and options of `rtloop ctl retune`; None stands for the command's default."""

    axis: Name
    amplitude_um: float | None = Field(default=None, gt=0)
    bound_percent: float | None = Field(default=None, gt=0, le=50)
    within_percent: float | None = Field(default=None, ge=0, le=50)


class TapsBody(Body):
    """Pre-filter of an axis: `taps` filter the reference, the output of `command_taps` is added to the command."""

    taps: Row
    command_taps: Row


class SwapBody(Body):
    """Body of `/api/swap`: the new taps of a proposal, `prefilter`, and the loop's taps that they replace."""

    axis: Name
    replaces: TapsBody
    prefilter: TapsBody


class Retuning:
    """Runs one `rtloop ctl retune` at a time."""

    def __init__(self, service: Service) -> None:
        """Prepare the runner of the command: one at a time, each for LONGEST_S at most."""
        self._service = service
        self._processes = ProcessRunner(max_running=1, max_unfinished=1, timeout_s=LONGEST_S)

    def routes(self) -> Sequence[BaseRoute]:
        """Return the routes `/api/retune` and `/api/swap`."""
        return [
            Route("/api/retune", self._retune, methods=["POST"]),
            Route("/api/swap", self._swap, methods=["POST"]),
        ]

    async def _retune(self, request: Request) -> Response:
        """Measure, design and respond with a proposal of new taps; the measurement ends if the page disconnects."""
        return await self._respond(request, RetuneBody, ends_with_page=True)

    async def _swap(self, request: Request) -> Response:
        """Give the loop the taps of a proposal, also if the page disconnects; respond with the command's JSON."""
        return await self._respond(request, SwapBody, ends_with_page=False)

    @with_error_responses
    async def _respond(self, request: Request, model: type[RetuneBody | SwapBody], ends_with_page: bool) -> Response:
        """Run the command for the body, of type `model`, and respond with its JSON, or with its error and status.

        `ends_with_page`: the command is killed if the page disconnects; the response is then empty.
        """
        body = validate_request(model, await limited_body(request, SMALL_BYTES))
        name = requester_name(request)
        with anyio.CancelScope() as scope:
            async with call_at_disconnect(request, scope.cancel) if ends_with_page else nullcontext():
                return JSONResponse(await self._run_command(name, body))
        return Response()

    async def _run_command(self, name: str, body: RetuneBody | SwapBody) -> dict[str, object]:
        """Run `rtloop ctl retune` for the body, under a client's `name`, and return the JSON object that it prints.

        Raises TooManyRequests while another such command runs, RequestRefused (409, 503 or 422) with the command's
        error.
        """
        ctl = ["ctl", f"--socket={self._service.client.path}", f"--as={name}", "retune", "--json"]
        if isinstance(body, SwapBody):
            options, stdin = ["--swap=-"], body.model_dump_json()
        else:
            values = body.model_dump(exclude={"axis"}, exclude_none=True)
            options, stdin = [f"--{key.replace('_', '-')}={value!r}" for key, value in values.items()], ""
        try:
            return await self._processes.run("rtloop", *ctl, *options, "--", body.axis, stdin=stdin)
        except ProcessFailed as error:
            raise RequestRefused(STATUS_BY_EXIT_CODE.get(error.code, 422), str(error)) from None

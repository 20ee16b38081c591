"""Recordings for pages: the list, files, figures, pictures, sweeps to compare with, and captures of what runs.

What takes long runs in a process of its own, few at a time; a sweep reads of a file what it shows.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Awaitable, Callable, Iterator, Sequence
from functools import wraps
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote

import anyio.to_thread
from anyio import CapacityLimiter
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Route
from starlette.types import Receive, Scope, Send

from rtloop.errors import RtloopError, UnavailableError
from rtloop.foundation.trusted import open_own, open_without_link
from rtloop.panel.capture import Run, current_run
from rtloop.panel.shelf.folder import RecordingFolder, shown_name
from rtloop.panel.shelf.process_runner import ProcessRunner, TooManyRequests
from rtloop.panel.shelf.reference import SweepRequest, sweep_frame
from rtloop.panel.views.service import Service
from rtloop.panel.web.proxy import limited_body
from rtloop.panel.web.requests import LONGEST_S, CaptureBody, Span, validate_request

MAX_READERS = 2
MAX_BODY_BYTES = 4096
AHEAD_S = 60.0
BLOCK_BYTES = 1 << 16


class PlainJSONResponse(JSONResponse):
    """JSON in ASCII: a name that is no UTF-8 prevents no answer."""

    def render(self, content: Any) -> bytes:
        """Encode `content`, which holds finite numbers."""
        return json.dumps(content, allow_nan=False).encode("ascii")


Handler = Callable[[Any, Request], Awaitable[Response]]


class RequestRefused(Exception):
    """An answer that is no success: its code, and why."""

    def __init__(self, code: int, error: str) -> None:
        super().__init__(error)
        self.code = code


def with_error_responses(handler: Handler) -> Handler:
    """What goes wrong becomes an answer that says why."""

    @wraps(handler)
    async def respond(self: Any, request: Request) -> Response:
        try:
            return await handler(self, request)
        except ClientDisconnect:
            return Response()
        except (RequestRefused, TooManyRequests, RtloopError, ValueError) as error:
            return PlainJSONResponse({"error": str(error)}, status_code(error))

    return respond


def status_code(error: Exception) -> int:
    """Return the HTTP status that answers an error of a recording."""
    if isinstance(error, RequestRefused):
        return error.code
    return 503 if isinstance(error, TooManyRequests | UnavailableError) else 422


class Recordings:
    """The recordings of a service; `run` is the number of the run that is shown now."""

    def __init__(self, service: Service, current_run: Callable[[], int]) -> None:
        self._service, self._current_run = service, current_run
        self._processes, self._readers = ProcessRunner(), CapacityLimiter(MAX_READERS)
        self._folder_cache: RecordingFolder | None = None

    def routes(self) -> Sequence[BaseRoute]:
        """Of all of them."""
        file_route = "/api/recordings/{file}"
        return [
            Route("/api/recordings", self.listing),
            Route(file_route, self.download),
            Route(f"{file_route}/info", self.info),
            Route(f"{file_route}/plot.png", self.plot),
            Route(f"{file_route}/sweep", self.sweep),
            Route("/api/capture", self.capture, methods=["POST"]),
        ]

    @with_error_responses
    async def listing(self, _: Request) -> Response:
        """What lies in the folder."""
        return JSONResponse(await self._run_in_thread(lambda: self._recording_folder().listing()))

    @with_error_responses
    async def download(self, request: Request) -> Response:
        """A file; of one that grows, what it holds now."""
        path = await self._recording_path(request)
        name = shown_name(path.name)
        try:
            file = await self._run_in_thread(lambda: os.fdopen(open_without_link(path), "rb"))
        except OSError as error:
            raise RequestRefused(404, f"{name}: {error.strerror}") from None
        if path.suffix == ".mcap":
            return OpenFileResponse(file, name)
        size = os.fstat(file.fileno()).st_size
        headers = {"content-length": str(size), "content-disposition": f"attachment; filename*=utf-8''{quote(name)}"}
        return StreamingResponse(_blocks(file, size), headers=headers, media_type="application/octet-stream")

    @with_error_responses
    async def info(self, request: Request) -> Response:
        """What `rtloop info --json` says."""
        return PlainJSONResponse(
            await self._processes.run("rtloop", "info", await self._recording_path(request), "--json")
        )

    @with_error_responses
    async def plot(self, request: Request) -> Response:
        """What `rtloop plot` draws; `from` and `until` in s."""
        path = await self._recording_path(request)
        span_request = validate_request(Span, dict(request.query_params))
        span = [
            f"--{name}={value}" for name, value in span_request.model_dump(by_alias=True, exclude_none=True).items()
        ]
        with tempfile.TemporaryDirectory(prefix="rtloop-panel-") as folder:
            picture = Path(folder) / "plot.png"
            await self._processes.run("rtloop", "plot", path, "--out", picture, "--json", *span)
            with os.fdopen(open_own(picture), "rb") as file:
                return Response(await anyio.to_thread.run_sync(file.read), media_type="image/png")

    @with_error_responses
    async def sweep(self, request: Request) -> Response:
        """A stretch as the scope shows it."""
        path, query = await self._recording_path(request), dict(request.query_params)
        sweep_request = validate_request(SweepRequest, query | {"signals": tuple(query.get("signals", "").split(","))})
        return Response(
            await self._run_in_thread(lambda: sweep_frame(path, sweep_request)), media_type="application/octet-stream"
        )

    @with_error_responses
    async def capture(self, request: Request) -> Response:
        """A stretch of the run that is shown as a recording of its own, replayed."""
        data = await limited_body(request, MAX_BODY_BYTES)
        if data is None:
            raise RequestRefused(413, f"request body: more than {MAX_BODY_BYTES} bytes")
        body = validate_request(CaptureBody, data)
        if body.run not in (None, self._current_run()):
            raise RequestRefused(410, f"run {body.run}: the loop was started anew since; its recording is in the list")
        run = await self._run_in_thread(lambda: current_run(self._service.client))
        first, end = await self._run_in_thread(lambda: self._tick_range(body, run))
        socket = self._service.client.path.resolve()
        return JSONResponse(await self._processes.run("rtloop.panel.capture", socket, run.file, first, end))

    def _tick_range(self, body: CaptureBody, run: Run) -> tuple[int, int]:
        rate_hz = self._service.describe().rate_hz
        if body.first is None or body.end is None:
            assert body.seconds is not None
            return max(run.tick + 1 - round(body.seconds * rate_hz), 0), run.tick + 1
        if body.end - body.first > LONGEST_S * rate_hz:
            raise ValueError(f"ticks {body.first} to {body.end}: at most {LONGEST_S:g} s are captured at once")
        if body.end > run.tick + AHEAD_S * rate_hz:
            raise ValueError(
                f"end: {body.end}; at most {AHEAD_S:g} s behind the newest tick, {run.tick}, are waited for"
            )
        return max(body.first, 0), body.end

    def _recording_folder(self) -> RecordingFolder:
        """Where the service has its recordings, or had them when it answered last. Raises UnavailableError."""
        try:
            folder = self._service.describe().recordings
        except UnavailableError:
            if self._folder_cache is None:
                raise
            return self._folder_cache
        if self._folder_cache is None or self._folder_cache.folder != folder:
            self._folder_cache = RecordingFolder(folder)
        return self._folder_cache

    async def _recording_path(self, request: Request) -> Path:
        name = request.path_params["file"]
        path = await self._run_in_thread(lambda: self._recording_folder().path(name))
        if path is None:
            raise RequestRefused(404, f"{name[:100]!r}: no recording of this name is in the folder of recordings")
        return path

    async def _run_in_thread(self, action: Callable[[], Any]) -> Any:
        return await anyio.to_thread.run_sync(action, limiter=self._readers)


def routes(service: Service, run: Callable[[], int]) -> Sequence[BaseRoute]:
    """The routes of a service's recordings."""
    return Recordings(service, run).routes()


class OpenFileResponse(FileResponse):
    """A download of an open file, which is closed afterwards; ranges of it may be requested."""

    def __init__(self, file: IO[bytes], name: str) -> None:
        path, status = f"/proc/self/fd/{file.fileno()}", os.fstat(file.fileno())
        super().__init__(path, filename=name, media_type="application/octet-stream", stat_result=status)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file, or the ranges."""
        with self._file:
            await super().__call__(scope, receive, send)


def _blocks(file: IO[bytes], size: int) -> Iterator[bytes]:
    """The first `size` bytes of a file, which is closed afterwards."""
    with file:
        while size > 0 and (block := file.read(min(size, BLOCK_BYTES))):
            size -= len(block)
            yield block

"""Recordings for pages: listing, downloads, figures, pictures, sweeps for comparison, and captures of the running loop.

Long work runs in separate processes, few at a time; a sweep reads only the part of the file that it shows.
"""

from __future__ import annotations

import os
import secrets
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, TypeVar
from urllib.parse import quote

import anyio.to_thread
from anyio import CapacityLimiter
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Route
from starlette.types import Receive, Scope, Send

from rtloop.client.capture.tick_capture import RecordedRun, current_run
from rtloop.errors import UnavailableError
from rtloop.foundation import timing
from rtloop.foundation.trusted import open_own, open_without_link
from rtloop.panel.recordings.folder import RecordingFolder, shown_name
from rtloop.panel.recordings.process_runner import ProcessRunner
from rtloop.panel.recordings.reference_sweep import SweepRequest, sweep_frame
from rtloop.panel.service.service import Service
from rtloop.panel.web.requests import LONGEST_S, CaptureBody, Span, validate_request
from rtloop.panel.web.responses import PlainJSONResponse, RequestRefused, limited_body, with_error_responses

T = TypeVar("T")
MAX_READERS = 2
MAX_BODY_BYTES = 4096
AHEAD_S = 60.0
"""Longest wait of a capture for ticks that are still to come."""
BLOCK_BYTES = 1 << 16
TICKET_BYTES, TICKET_S, MAX_TICKETS = 24, 30.0, 64


class Recordings:
    """Handlers for the recordings of a service; `current_run` returns the number of the run that pages show."""

    def __init__(self, service: Service, current_run: Callable[[], int]) -> None:
        """Serve the recordings of `service`; `current_run()` is the number of the run that pages show."""
        self._service, self._current_run = service, current_run
        self._processes, self._readers = ProcessRunner(), CapacityLimiter(MAX_READERS)
        self._folder_cache: RecordingFolder | None = None
        self._tickets: dict[str, tuple[Path, float]] = {}

    def routes(self) -> Sequence[BaseRoute]:
        """Return the routes of all handlers."""
        file_route = "/api/recordings/{file}"
        return [
            Route("/api/recordings", self.listing),
            Route(file_route, self.download),
            Route(f"{file_route}/ticket", self.ticket, methods=["POST"]),
            Route("/download/{ticket}", self.ticket_download),
            Route(f"{file_route}/info", self.info),
            Route(f"{file_route}/plot.png", self.plot),
            Route(f"{file_route}/sweep", self.sweep),
            Route("/api/capture", self.capture, methods=["POST"]),
        ]

    @with_error_responses
    async def listing(self, _: Request) -> Response:
        """Respond with `RecordingFolder.listing` of the folder of recordings; 503 without a known folder."""
        return JSONResponse(await self._run_in_thread(lambda: self._recording_folder().listing()))

    @with_error_responses
    async def download(self, request: Request) -> Response:
        """Respond with the recording in the address; with the present content of a file that still grows.

        A request may name ranges of bytes of a finished file (.mcap). 404 for a file that is not in the folder of
        recordings, or was removed meanwhile.
        """
        return await self._send(await self._recording_path(request))

    @with_error_responses
    async def ticket(self, request: Request) -> Response:
        """Respond with the `path` from which a browser downloads the recording once, within TICKET_S, without a header.

        404 for a file that is not in the folder of recordings.
        """
        path, ticket = await self._recording_path(request), secrets.token_urlsafe(TICKET_BYTES)
        self._tickets[ticket] = path, timing.monotonic_s() + TICKET_S
        while len(self._tickets) > MAX_TICKETS:
            del self._tickets[next(iter(self._tickets))]
        return JSONResponse({"path": f"/download/{ticket}"})

    @with_error_responses
    async def ticket_download(self, request: Request) -> Response:
        """Respond like `download` with the recording of the ticket in the address; 404 for a used or old ticket."""
        path, until_s = self._tickets.pop(request.path_params["ticket"], (Path(), 0.0))
        if timing.monotonic_s() > until_s:
            raise RequestRefused(
                404, f"used before, or older than {TICKET_S:g} s; start the download on the page again"
            )
        return await self._send(path)

    @with_error_responses
    async def info(self, request: Request) -> Response:
        """Respond with the JSON of `rtloop info --json` for the recording in the address, or 422 with its error.

        404 for a file that is not in the folder of recordings.
        """
        return PlainJSONResponse(
            await self._processes.run("rtloop", "info", await self._recording_path(request), "--json")
        )

    @with_error_responses
    async def plot(self, request: Request) -> Response:
        """Respond with the PNG of `rtloop plot` for the recording in the address, or 422 with its error.

        The query may give `from` and `until`, in s since the start of the run. 404 for a file that is not in the folder
        of recordings.
        """
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
        """Respond with a sweep from the recording in the address, as the scope's binary message "sweep".

        The query has the fields of SweepRequest, with commas between the signals. 422 for an invalid query, and for
        ticks or signals that the file does not have; 404 for a file that is not in the folder of recordings.
        """
        path, query = await self._recording_path(request), dict(request.query_params)
        sweep_request = validate_request(SweepRequest, query | {"signals": tuple(query.get("signals", "").split(","))})
        return Response(
            await self._run_in_thread(lambda: sweep_frame(path, sweep_request)), media_type="application/octet-stream"
        )

    @with_error_responses
    async def capture(self, request: Request) -> Response:
        """Save ticks `first` … `end` − 1 of the running loop as a recording, once the last is written, and replay it.

        The body is a CaptureBody. Responds with {file (name), first, end, ticks (number), gaps, problems, replay
        (verdict)}; 410 if the loop was started again since the run in the body.
        """
        body = validate_request(CaptureBody, await limited_body(request, MAX_BODY_BYTES))
        if body.run not in (None, self._current_run()):
            raise RequestRefused(
                410,
                f"run {body.run}: the loop was started again since this run; the run's recording is in the list of "
                "recordings",
            )
        run = await self._run_in_thread(lambda: current_run(self._service.client))
        first, end = await self._run_in_thread(lambda: self._tick_range(body, run))
        socket = self._service.client.path.resolve()
        return JSONResponse(
            await self._processes.run("rtloop.client.capture.tick_capture", socket, run.file, first, end)
        )

    async def _send(self, path: Path) -> Response:
        """Return the response with the content of a recording.

        Raises RequestRefused (404) for a file that was removed meanwhile.
        """
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

    def _tick_range(self, body: CaptureBody, run: RecordedRun) -> tuple[int, int]:
        """Return the first tick of a capture, at least 0, and the tick after its last one.

        Without ticks in `body` they are the last `seconds` up to the newest tick of `run`. Raises ValueError for more
        than LONGEST_S, or an end more than AHEAD_S in the future; UnavailableError without a loop.
        """
        rate_hz = self._service.describe().rate_hz
        if body.first is None or body.end is None:
            return max(run.tick + 1 - round((body.seconds or 0.0) * rate_hz), 0), run.tick + 1
        if body.end - body.first > LONGEST_S * rate_hz:
            raise ValueError(
                f"ticks {body.first} to {body.end - 1}: {(body.end - body.first) / rate_hz:.4g} s; allowed: at "
                f"most {LONGEST_S:g} s"
            )
        if body.end > run.tick + AHEAD_S * rate_hz:
            raise ValueError(f"end: tick {body.end}; allowed: at most {AHEAD_S:g} s after the newest tick, {run.tick}")
        return max(body.first, 0), body.end

    def _recording_folder(self) -> RecordingFolder:
        """Return the service's folder of recordings; without a running loop, the last known one.

        Raises UnavailableError without either.
        """
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
        """Return the path of the recording in the request's address. Raises RequestRefused (404) if there is none.

        Raises UnavailableError as `_recording_folder`.
        """
        name = request.path_params["file"]
        path = await self._run_in_thread(lambda: self._recording_folder().path(name))
        if path is None:
            raise RequestRefused(404, f"{name[:100]!r}: no recording of this name is in the folder of recordings")
        return path

    async def _run_in_thread(self, action: Callable[[], T]) -> T:
        """Run an action in one of MAX_READERS threads, once one is free, and return its result or raise its error."""
        return await anyio.to_thread.run_sync(action, limiter=self._readers)


class OpenFileResponse(FileResponse):
    """A download of an open file, also of ranges; the file is closed afterwards."""

    def __init__(self, file: IO[bytes], name: str) -> None:
        """Send the content of the open `file` as a download; `name` is the file name that the browser gets."""
        path, status = f"/proc/self/fd/{file.fileno()}", os.fstat(file.fileno())
        super().__init__(path, filename=name, media_type="application/octet-stream", stat_result=status)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file or the ranges of bytes that the request names, then close the file."""
        with self._file:
            await super().__call__(scope, receive, send)


def _blocks(file: IO[bytes], size: int) -> Iterator[bytes]:
    """Yield the first `size` bytes of a file in blocks of at most BLOCK_BYTES, fewer bytes if the file ends, then
    close it.
    """
    with file:
        while size > 0 and (block := file.read(min(size, BLOCK_BYTES))):
            size -= len(block)
            yield block

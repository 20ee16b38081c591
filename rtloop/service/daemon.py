"""`rtloop serve`: the service with its control socket, signals and journal."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import uvicorn

from rtloop.errors import UnavailableError
from rtloop.foundation import timing
from rtloop.foundation.trusted import UntrustedPath, close_descriptor, open_folder
from rtloop.service.api.application import application
from rtloop.service.api.connections import BACKLOG, server_settings
from rtloop.service.can_bus import can_supervision
from rtloop.service.changing.building import builder_lifetime
from rtloop.service.journal import Journal
from rtloop.service.measuring.adaptation import run_adaptation
from rtloop.service.measuring.quality import watch_quality
from rtloop.service.recovering.worker import run_recovery
from rtloop.service.service import Service
from rtloop.supervision.paths import FOLDER_MODE, host_refusal, socket_path

END_TIMEOUT_S = 5.0
THREAD_START_ERROR = "can't start new thread"
"""Part of the message of Python's RuntimeError for a thread that cannot be started."""


def serve(config: Path, duration_s: float | None = None, name: str | None = None) -> int:
    """Serve a configuration until SIGTERM or SIGINT, or until a loop has run for `duration_s`. Returns the exit code.

    SIGHUP reloads the file. The handlers of these signals replace the process's own, and log messages go to stderr.
    `name` is the service's name in place of the file's. Raises RtloopError and DriverError; UnavailableError if the
    system refuses a resource, such as a file, a socket or a thread.
    """
    with _host_errors():
        _log_to_stderr()
        return _serve(config, duration_s, name)


def _serve(config: Path, duration_s: float | None, name: str | None) -> int:
    """Do the work of `serve`, except that log messages must go to stderr already, and that OSError and RuntimeError of
    the system are raised as they are.
    """
    service = Service(config, duration_s, name)
    for signal_number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(signal_number, lambda *_: service.end())
    signal.signal(signal.SIGHUP, lambda *_: service.request_reload())
    try:
        adaptation = run_adaptation(service, socket_path(service.configuration))
        quality_watch = watch_quality(service.quality, lambda: (service.supervisor, service.limits))
        recovery = run_recovery(service, service.recovery)
        with builder_lifetime(), _api_server(service), can_supervision(service), adaptation, quality_watch, recovery:
            return service.run()
    finally:
        logging.getLogger().handlers[0].flush()


@contextlib.contextmanager
def _host_errors() -> Iterator[None]:
    """Raise UnavailableError in place of an OSError of the work within, and of its RuntimeError for a thread that
    cannot be started.
    """
    try:
        yield
    except OSError as error:
        place = "" if error.filename is None else f"{error.filename}: "
        raise UnavailableError(
            f"the operating system refuses a resource that the service needs: {place}{error.strerror or error}"
        ) from error
    except RuntimeError as error:
        if THREAD_START_ERROR not in str(error):
            raise
        raise UnavailableError(f"the operating system refuses a resource that the service needs: {error}") from error


@contextlib.contextmanager
def _api_server(service: Service) -> Iterator[None]:
    """Serve the API on its socket, in a thread, during the work within; then remove the socket. Raises as `_bind`."""
    path = socket_path(service.configuration)
    listener = _bind(path, int(service.configuration.service.socket_mode, 8))
    server = uvicorn.Server(server_settings(application(service)))
    thread = timing.start_thread(lambda: asyncio.run(server.serve(sockets=[listener])))
    try:
        yield
    finally:
        server.should_exit = server.force_exit = True
        thread.join(END_TIMEOUT_S)
        with contextlib.suppress(OSError):  # The next service removes a socket that stays.
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            listener.close()


def _bind(path: Path, mode: int) -> socket.socket:
    """Return a listening socket at `path` with permissions `mode` and, if possible, the folder's group.

    Missing folders are made (FOLDER_MODE); the socket of a service that died is removed. Raises UnavailableError if
    another service listens at `path`, the path is no socket or the system refuses, HostRefusal for a folder that
    another user owns or may change.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        folder = open_folder(path.parent, FOLDER_MODE)
        try:
            group = os.fstat(folder).st_gid
        finally:
            close_descriptor(folder)
        _remove_stale_socket(path)
        previous_umask = os.umask(0o777)
        try:
            listener.bind(str(path))
        finally:
            os.umask(previous_umask)
        with contextlib.suppress(PermissionError):
            os.chown(path, -1, group)
        os.chmod(path, mode)
        listener.listen(BACKLOG)
        return listener
    except BaseException as error:
        listener.close()
        if isinstance(error, UntrustedPath):
            raise host_refusal(error) from None
        if isinstance(error, OSError):
            raise UnavailableError(f"{path}: {error.strerror or error}") from None
        raise


def _remove_stale_socket(path: Path) -> None:
    """Remove the socket of a service that has died from `path`; no effect without a file at this path.

    Raises UnavailableError if the path is no socket or a service listens at it, OSError if the system refuses.
    """
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise UnavailableError(
                f"{path}: the file exists and is not a socket; move the file, or set service.socket to another path"
            )
        with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as probe:
            probe.setblocking(False)
            probe.connect(str(path))
        raise UnavailableError(
            f"{path}: another service uses this control socket; stop that service, or give this service another name "
            "with --name NAME"
        )
    except BlockingIOError:  # The queue of a living service is full.
        raise UnavailableError(
            f"{path}: another service uses this control socket; stop that service, or give this service another name "
            "with --name NAME"
        ) from None
    except ConnectionRefusedError:
        path.unlink()
    except FileNotFoundError:
        pass


class _JournalFormatter(logging.Formatter):
    """Formatter of lines with a priority `<n>`, which the journal reads (sd-daemon(3))."""

    PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))

    def format(self, record: logging.LogRecord) -> str:
        """Return `<priority>message`, with syslog's number: 3 for errors, 4 warnings, 6 information, 7 the rest."""
        priority = next((number for level, number in self.PRIORITIES if record.levelno >= level), 7)
        return f"<{priority}>{super().format(record)}"


def _log_to_stderr() -> None:
    """Send log messages from INFO on to stderr, with priorities under systemd, else with times.

    This handler replaces all others of the root logger.
    """
    handler = Journal()
    is_under_systemd = "JOURNAL_STREAM" in os.environ
    handler.setFormatter(
        _JournalFormatter("%(message)s") if is_under_systemd else logging.Formatter("%(asctime)s %(message)s")
    )
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)

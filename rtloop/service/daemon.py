"""`rtloop serve`: the service with its control socket, signals and journal."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import uvicorn

from rtloop.errors import UnavailableError
from rtloop.foundation.trusted import UntrustedPath, close_descriptor, open_folder
from rtloop.service.api.application import application
from rtloop.service.api.connections import BACKLOG, settings
from rtloop.service.can_bus import supervised_by_can
from rtloop.service.changing.building import builder_ended
from rtloop.service.journal import Journal
from rtloop.service.measuring.adaptation import adapting
from rtloop.service.measuring.quality import summed
from rtloop.service.service import Service
from rtloop.supervision.paths import FOLDER_MODE, host_refusal, socket_path

END_TIMEOUT_S = 5.0
NO_THREAD = "can't start new thread"
"""What Python says of it; it has no class of its own."""


def serve(config: Path, duration_s: float | None = None, name: str | None = None) -> int:
    """Serve a configuration until SIGTERM or SIGINT, or until a loop has run so long; SIGHUP reloads. The exit code.

    `name` names the service, in place of its file.

    Raises RtloopError.
    """
    with _refused_in_words():
        _log_to_stderr()
        return _serve(config, duration_s, name)


def _serve(config: Path, duration_s: float | None, name: str | None) -> int:
    """As `serve`, with the journal there; raises OSError and RuntimeError too, where the system refuses something."""
    service = Service(config, duration_s, name)
    for signal_number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(signal_number, lambda *_: service.end())
    signal.signal(signal.SIGHUP, lambda *_: service.reload())
    try:
        adaptation = adapting(service, socket_path(service.configuration))
        quality_watch = summed(service.quality, lambda: (service.supervisor, service.limits))
        with builder_ended(), _listening(service), supervised_by_can(service), adaptation, quality_watch:
            return service.run()
    finally:
        logging.getLogger().handlers[0].flush()


@contextlib.contextmanager
def _refused_in_words() -> Iterator[None]:
    """Raise UnavailableError for what the system refuses: in place of OSError, and where no thread can be started."""
    try:
        yield
    except OSError as error:
        raise UnavailableError(f"the host refuses what the service needs: {error.strerror or error}") from error
    except RuntimeError as error:
        if NO_THREAD not in str(error):
            raise
        raise UnavailableError(f"the host refuses what the service needs: {error}") from error


@contextlib.contextmanager
def _listening(service: Service) -> Iterator[None]:
    """The API on its socket, in a thread of its own, for as long as the service runs."""
    path = socket_path(service.configuration)
    listener = _bind(path, int(service.configuration.service.socket_mode, 8))
    server = uvicorn.Server(settings(application(service)))
    thread = threading.Thread(target=lambda: asyncio.run(server.serve(sockets=[listener])), daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.should_exit = server.force_exit = True
        thread.join(END_TIMEOUT_S)
        with contextlib.suppress(OSError):  # a socket that stays is cleared by the next service
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            listener.close()


def _bind(path: Path, mode: int) -> socket.socket:
    """A listening socket with exactly these permissions, of the folder's group where we may give it that.

    Raises UnavailableError where another service listens or something else than a socket stands, HostRefused for a
    folder that others may write to.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        folder = open_folder(path.parent, FOLDER_MODE)
        try:
            group = os.fstat(folder).st_gid
        finally:
            close_descriptor(folder)
        _clear(path)
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
    except UntrustedPath as error:
        listener.close()
        raise host_refusal(error) from None
    except OSError as error:
        listener.close()
        raise UnavailableError(f"{path}: {error.strerror or error}") from None
    except UnavailableError:
        listener.close()
        raise


def _clear(path: Path) -> None:
    """Remove a socket that nobody serves any more. Raises UnavailableError, OSError."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise UnavailableError(f"{path}: is there and no socket; it is not touched")
        with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as probe:
            probe.setblocking(False)
            probe.connect(str(path))
        raise UnavailableError(f"{path}: another service listens there")
    except BlockingIOError:  # so many clients that they must wait
        raise UnavailableError(f"{path}: another service listens there") from None
    except ConnectionRefusedError:
        path.unlink()
    except FileNotFoundError:
        pass


class _JournalFormatter(logging.Formatter):
    """Lines with the priority that the journal reads from `<n>` (sd-daemon(3))."""

    PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))

    def format(self, record: logging.LogRecord) -> str:
        """`<priority>message`."""
        priority = next((number for level, number in self.PRIORITIES if record.levelno >= level), 7)
        return f"<{priority}>{super().format(record)}"


def _log_to_stderr() -> None:
    handler = Journal()
    is_under_systemd = "JOURNAL_STREAM" in os.environ
    handler.setFormatter(
        _JournalFormatter("%(message)s") if is_under_systemd else logging.Formatter("%(asctime)s %(message)s")
    )
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)

"""Workers that run functions: processes of this machine, or the workers of a Dask scheduler. Both return futures."""

from __future__ import annotations

import logging
import multiprocessing
import multiprocessing.forkserver
import os
import re
import signal
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from ipaddress import ip_address
from typing import Any, Protocol, TypeVar

from rtloop.errors import MissingExtra, UnavailableError
from rtloop.foundation.children import child_environment
from rtloop.foundation.heap import keep_freed_memory
from rtloop.version import __version__

Result = TypeVar("Result")
START = "start it with `dask scheduler --host 127.0.0.1`"
CONNECT_S = 10.0
"""Time after which a scheduler that does not answer counts as unreachable."""


NOISY_LOGGERS = ("distributed", "distributed.client", "asyncio")
"""Loggers that print tracebacks when a scheduler is gone, which `explain` says in one sentence."""


class WorkerDied(Exception):
    """The worker's process died while it ran a function, or another function in the same pool of processes."""


class Workers(Protocol):
    """Processes that run functions at the same time."""

    count: int
    """Functions that run at the same time."""
    name: str
    """Kind, number and address of the workers, for messages."""

    def submit(self, function: Callable[..., Result], *arguments: object) -> Future[Result]:
        """Start a function of a module in a worker; return the future of its result.

        `explain` converts the errors of the future, and of this call where the workers have died before it.
        """
        ...

    def explain(self, error: BaseException) -> BaseException:
        """Return WorkerDied or UnavailableError where an error of a future means that; else the error itself."""
        ...

    def recover(self) -> None:
        """Make the workers usable again after WorkerDied."""
        ...

    def close(self) -> None:
        """End the workers; functions that run are awaited, functions that wait are dropped."""
        ...


class ProcessWorkers:
    """Worker processes of this machine. A fork of this process, which may have threads, is never used."""

    def __init__(
        self,
        count: int | None = None,
        preload: str = "rtloop.campaigns.unit",
    ) -> None:
        """Use `count` processes, by default one for each processor that this process may use.

        The module `preload` is imported once for all processes.
        """
        self.count = count or len(os.sched_getaffinity(0))
        self.name = f"{self.count} worker process{'es' if self.count > 1 else ''}"
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([preload])
        self._has_server = False
        self._executor = self._start()

    def submit(self, function: Callable[..., Result], *arguments: object) -> Future[Result]:
        """Start a function of a module in one of the processes; return the future of its result.

        Raises BrokenProcessPool if a process of the pool has died.
        """
        if not self._has_server:
            _start_forkserver()
            self._has_server = True
        return self._executor.submit(function, *arguments)

    def explain(self, error: BaseException) -> BaseException:
        """Return WorkerDied for a pool that is broken, any other error itself."""
        return WorkerDied() if isinstance(error, BrokenProcessPool) else error

    def recover(self) -> None:
        """Replace the broken pool by a new one; functions that had not ended are dropped."""
        self._executor.shutdown(wait=True, cancel_futures=True)
        self._executor = self._start()

    def close(self) -> None:
        """Wait for the functions that run, drop the waiting ones, and end the processes."""
        self._executor.shutdown(wait=True, cancel_futures=True)

    def _start(self) -> Executor:
        """Return a new pool of processes, which leave Ctrl-C to the coordinator and end with it."""
        return ProcessPoolExecutor(self.count, mp_context=self._context, initializer=_follow_coordinator)


def _start_forkserver() -> None:
    """Start the server that makes worker processes, with the environment of a child; no effect if it runs already."""
    before, environment = dict(os.environ), child_environment()
    os.environ.clear()
    os.environ.update(environment)
    try:
        multiprocessing.forkserver.ensure_running()
    finally:
        os.environ.clear()
        os.environ.update(before)


def _follow_coordinator() -> None:
    """Prepare this worker: ignore Ctrl-C, end when the coordinator has died, keep the memory of one rig for the next.

    After Ctrl-C, the coordinator ends its workers once their functions have ended.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    keep_freed_memory()
    threading.Thread(target=_end_after_coordinator, daemon=True).start()


def _end_after_coordinator() -> None:
    """Wait until the coordinator has died, then end this worker at once; the pool's workers would wait forever."""
    if (coordinator := multiprocessing.parent_process()) is not None:
        coordinator.join()
        os._exit(1)


class DaskWorkers:
    """The workers of a Dask scheduler. Their machines need rtloop of the same version.

    Raises MissingExtra without dask.distributed, UnavailableError for a scheduler that cannot be reached or has no
    worker, and for another version of rtloop there.
    """

    def __init__(self, scheduler: Any) -> None:
        """Use a scheduler by its address, such as tcp://HOST:8786, or a `dask.distributed.Client`.

        With an address, a client is made, which `close` ends, and NOISY_LOGGERS are silenced. Raises as the class
        says.
        """
        try:
            from distributed import Client
        except ImportError:
            raise MissingExtra(
                "a scheduler needs dask.distributed; install it with pip install 'rtloop[campaign]'"
            ) from None
        self._owns_client = not isinstance(scheduler, Client)
        if self._owns_client:
            _require_reachable(scheduler)
            _require_encryption(scheduler)
            for name in NOISY_LOGGERS:
                logging.getLogger(name).setLevel(logging.CRITICAL)
            try:
                scheduler = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
            except (OSError, ValueError, TimeoutError) as error:
                raise UnavailableError(f"scheduler {scheduler}: {error}; {START}") from None
        self._client: Any = scheduler
        self.count = sum(self._client.nthreads().values())
        self.name = f"Dask scheduler {self._client.scheduler.address}, dashboard {self._client.dashboard_link}"
        if not self.count:
            self.close()
            raise UnavailableError(
                f"{self.name}: no worker is connected; start `dask worker ADDRESS --host 127.0.0.1 --nthreads 1`"
            )
        self._require_versions()
        self._executor = self._client.get_executor(pure=False)

    def _require_versions(self) -> None:
        """Close, and raise UnavailableError, for a scheduler or worker without rtloop or with another version of it.

        The workers import at the same time the modules that a unit needs.
        """

        def version_there(module: str) -> str:  # pickled by value, as rtloop may be missing there
            """Return "rtloop VERSION" once `module` is imported, or "no rtloop (REASON)" if it cannot be."""
            from importlib import import_module

            try:
                import_module(module)
                from rtloop.version import __version__
            except ImportError as error:
                return f"no rtloop ({error})"
            return f"rtloop {__version__}"

        versions = {
            "the scheduler": self._client.run_on_scheduler(version_there, "rtloop.version"),
            **self._client.run(version_there, "rtloop.campaigns.unit"),
        }
        mismatches = [f"{place} has {text}" for place, text in versions.items() if text != f"rtloop {__version__}"]
        if mismatches:
            self.close()
            raise UnavailableError(f"{self.name}: {'; '.join(mismatches)}; install rtloop {__version__} there")

    def warnings(self) -> list[str]:
        """Return a warning if other hosts may reach the scheduler or a worker, as Dask's default is, without TLS."""
        addresses = [self._client.scheduler_info()["address"], *self._client.nthreads()]
        if not (exposed := [address for address in addresses if is_exposed(address)]):
            return []
        more = f" and {len(exposed) - 1} more addresses" if len(exposed) > 1 else ""
        return [
            f"Dask at {exposed[0]}{more}: open to other hosts without TLS; who reaches it can run any program as the "
            "user of the scheduler, of its workers and of this command; use --host 127.0.0.1 or TLS: docs/campaigns.md"
        ]

    def submit(self, function: Callable[..., Result], *arguments: object) -> Future[Result]:
        """Start a function of a module in one of the scheduler's workers; return the future of its result."""
        return self._executor.submit(function, *arguments)

    def explain(self, error: BaseException) -> BaseException:
        """Return WorkerDied where a function killed its workers, UnavailableError where the scheduler is gone.

        A cancelled function or a closed connection means that the scheduler is gone. Returns any other error itself.
        """
        from concurrent.futures import CancelledError

        from distributed import KilledWorker
        from distributed.comm.core import CommClosedError

        if isinstance(error, KilledWorker):
            return WorkerDied()
        if isinstance(error, CancelledError | CommClosedError | ConnectionError):
            return UnavailableError(
                f"{self.name}: the connection to the scheduler is lost; run the same command again to continue"
            )
        return error

    def recover(self) -> None:
        """Return at once: the scheduler's nannies start new workers."""

    def close(self) -> None:
        """Close the client that was made for the scheduler's address; a client that was given stays connected."""
        if self._owns_client:
            self._client.close()


def is_exposed(address: str) -> bool:
    """Return whether another host may reach an address of Dask, such as tcp://HOST:PORT, that needs no certificate."""
    scheme, _, place = address.partition("://")
    if scheme in ("tls", "wss", "inproc"):
        return False
    host = place.rpartition(":")[0].strip("[]")
    try:
        return not ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


def _require_encryption(address: str) -> None:
    """Raise UnavailableError for an address with TLS if Dask's configuration has no usable certificate, and for one
    without TLS if it requires TLS.
    """
    from distributed.security import Security

    has_tls = address.startswith("tls:")
    try:
        security = Security()
        has_certificate = security.get_connection_args("client").get("ssl_context") is not None
    except (OSError, TypeError, ValueError) as error:
        raise UnavailableError(f"scheduler {address}: Dask's certificate cannot be read: {error}") from None
    if security.require_encryption and not has_tls:
        raise UnavailableError(f"scheduler {address}: Dask's configuration requires TLS; allowed: tls://HOST:PORT")
    if has_tls and not has_certificate:
        raise UnavailableError(
            f"scheduler {address}: Dask has no certificate here; set distributed.comm.tls, as docs/campaigns.md shows"
        )


def _require_reachable(address: str) -> None:
    """Raise UnavailableError unless `address` is tcp://HOST:PORT or tls://HOST:PORT, and a process listens there."""
    form = re.fullmatch(r"(?:tcp|tls)://(\[[^\]]+\]|[^:/]+):(\d{1,5})", address)
    if form is None:
        raise UnavailableError(f"scheduler: {address}; allowed: tcp://HOST:PORT or tls://HOST:PORT")
    try:
        socket.create_connection((form[1].strip("[]"), int(form[2])), CONNECT_S).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UnavailableError(f"scheduler {address}: {reason}; {START}") from None

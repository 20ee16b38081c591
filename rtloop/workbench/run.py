"""`rtloop.run`: run the loop of a configuration, record every tick, and return the figures of the run."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Protocol

from rtloop.configuration.cautions import option_cautions
from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.drivers.errors import DriverError
from rtloop.errors import RtloopError, UnavailableError
from rtloop.foundation.native.cache import CACHE_FOLDER, CACHE_IS_PERSISTENT
from rtloop.recording.views.summary import summarise
from rtloop.supervision.interruption import Interruption
from rtloop.supervision.recording_path import new_recording_path
from rtloop.supervision.supervisor import Processes, Supervisor, process_age_s
from rtloop.workbench.arguments import FileName, as_path, load_configuration, require_seconds
from rtloop.workbench.run_result import RunResult

TEMPORARY_CACHE = (
    f"no cache folder can be written: the compiled code is in {CACHE_FOLDER}. Once that folder is deleted, rtloop "
    "compiles the code again"
)


class RunObserver(Protocol):
    """Receiver of the stages of a run."""

    def warn(self, warnings: Sequence[str]) -> None:
        """Receive the warnings about the configuration, before the loop begins."""

    def recover_leftovers(self, folder: Path) -> None:
        """Receive the folder of recordings, before the loop begins; it may hold unfinished files of killed runs."""

    def watch(self, prepared: Prepared) -> AbstractContextManager[Callable[[Supervisor], None] | None]:
        """Return a context for the time in which the loop runs.

        The value of the context is a function, called with the supervisor every PROGRESS_PERIOD_S, or None for none.
        """
        ...


class SilentObserver:
    """Receiver that ignores the stages of a run; unfinished files of killed runs stay as they are."""

    def warn(self, warnings: Sequence[str]) -> None:
        """Ignore the warnings: the result has them."""

    def recover_leftovers(self, folder: Path) -> None:
        """Leave unfinished files as they are."""

    def watch(self, prepared: Prepared) -> AbstractContextManager[None]:
        """Return a context without a value: no progress is shown."""
        return nullcontext()


def run(
    configuration: FileName | Configuration,
    *,
    duration_s: float | None = None,
    unpaced: bool = False,
    folder: FileName | None = None,
) -> RunResult:
    """Run the loop of a configuration for `duration_s`, record every tick, and return the result.

    With None, it runs until Ctrl-C or SIGTERM. `unpaced` runs in virtual time, as fast as the machine allows, on
    simulated hardware only. Recordings go to `folder` in place of the configured one. Ctrl-C and SIGTERM in the main
    thread ramp the outputs down and end the run, which then returns its result with the outcome "stopped"; in another
    thread no handler is installed, and `duration_s` is needed. The function returns a result also for a run that
    tripped or failed: see `outcome`, `trips`, `error`.
    Raises RtloopError for a run that cannot start.

    >>> result = rtloop.run("deploy/paper.toml", duration_s=0.3, unpaced=True, folder="recordings")
    >>> result.outcome, result.ticks, result.trips
    ('done', 3000, [])
    >>> result.steps["x"].settling_time_ms
    4.2
    """
    if duration_s is not None:
        duration_s = require_seconds(duration_s, "run: duration_s")
    elif threading.current_thread() is not threading.main_thread():
        raise RtloopError(
            "run: duration_s: value is None; allowed outside the main thread: a number of seconds above 0, because no "
            "Ctrl-C could end the run"
        )
    if not isinstance(configuration, Configuration):
        configuration = as_path(configuration, "run: configuration")
    target = None if folder is None else as_path(folder, "run: folder")
    called_at_age_s = 0.0
    with suppress(OSError):  # for information only
        called_at_age_s = process_age_s()
    with Interruption() as interruption:
        try:
            observer = SilentObserver()
            return run_loop(configuration, duration_s, not unpaced, target, interruption, observer, called_at_age_s)
        except DriverError as error:
            raise UnavailableError(str(error)) from error


def run_loop(
    configuration: FileName | Configuration,
    duration_s: float | None,
    paced: bool,
    folder: Path | None,
    interruption: Interruption,
    observer: RunObserver,
    called_at_age_s: float = 0.0,
) -> RunResult:
    """Run the loop of a configuration, report its stages to `observer`, and return the result.

    A SIGINT or SIGTERM that `interruption` catches stops the loop; after one that came before the loop began, the
    result has no `supervised` run. `paced` is False for virtual time, `duration_s` None for a run without an end.
    `called_at_age_s` is the age of this process at the call, s; the result's `startup_s` counts from then on. Raises
    RtloopError, DriverError if the run cannot start.
    """
    with Processes() as processes:
        loaded = load_configuration(configuration, "run")
        prepared = prepare(loaded, duration_s=duration_s, paced=paced)
        warnings = [*prepared.warnings, *option_cautions(prepared)]
        observer.warn([*warnings, *(() if CACHE_IS_PERSISTENT else (TEMPORARY_CACHE,))])
        path = new_recording_path(prepared, folder)
        observer.recover_leftovers(path.parent)
        if interruption.requested:
            return RunResult(prepared, None, None, warnings, None)
        supervisor = Supervisor(processes, prepared, path)
        interruption.set_supervisor(supervisor)
        with observer.watch(prepared) as show_progress:
            supervised = supervisor.run(show_progress)
        interruption.set_supervisor(None)
    summary = summarise(supervised.recordings) if supervised.recordings else None
    startup_s = None if supervisor.startup_s is None else supervisor.startup_s - called_at_age_s
    return RunResult(prepared, supervised, summary, warnings, startup_s)

"""Traced side of a try: the process waits until it is traced, marks its work in the trace, and stores its error."""

from __future__ import annotations

import os
import signal
import threading
import traceback
from collections.abc import Callable
from pathlib import Path

from rtloop.drivers.errors import DriverError
from rtloop.errors import RtloopError

BEGIN, END = "/rtloop-begin", "/rtloop-end"
"""Paths that do not exist; the child calls `access` on them to mark begin and end of its work in the trace."""
GO = signal.SIGUSR1
PREPARED = "prepared"
"""Name of the file that holds the id of the thread to trace."""
CLEAR, REFUSED, CRASHED = 0, 1, 2
"""Exit codes of the traced process."""


def begin_here(folder: Path) -> None:
    """In the child: have this thread traced, wait for GO, and mark the begin of the tried calls."""
    new = folder / f"{PREPARED}.new"
    new.write_text(str(threading.get_native_id()))
    new.rename(folder / PREPARED)
    signal.sigwait([GO])
    os.access(BEGIN, 0)


def end_here() -> None:
    """In the child: mark the end of the tried calls."""
    os.access(END, 0)


def work_and_exit(prepare: Callable[[], object] | None, work: Callable[[], object], error: Path) -> None:
    """Wait for GO, do the work between the marks, write an error to `error`, and exit; never returns."""
    code = CLEAR
    try:
        if prepare is not None:
            prepare()
            begin_here(error.parent)
        try:
            work()
        except (RtloopError, DriverError) as refusal:
            end_here()
            code = REFUSED
            error.write_text(str(refusal) or type(refusal).__name__)
        end_here()
    except BaseException:
        end_here()
        code = CRASHED
        error.write_text(traceback.format_exc())
    finally:
        os._exit(code)

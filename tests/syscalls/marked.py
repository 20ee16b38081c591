"""The side of the process that is traced: it waits until it is, marks its work in the trace, says how it ended."""

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
"""Looked for by the child, in vain: they mark the work in the trace."""
GO = signal.SIGUSR1
PREPARED = "prepared"
"""The file that holds the number of the thread that is to be traced."""
CLEAR, REFUSED, CRASHED = 0, 1, 2
"""Exit codes."""


def begin_here(folder: Path) -> None:
    """Have this thread traced, wait for GO and mark the beginning; in the child."""
    new = folder / f"{PREPARED}.new"
    new.write_text(str(threading.get_native_id()))
    new.rename(folder / PREPARED)
    signal.sigwait([GO])
    os.access(BEGIN, 0)


def end_here() -> None:
    """Mark the end of what is tried; in the child."""
    os.access(END, 0)


def work_and_exit(prepare: Callable[[], object] | None, work: Callable[[], object], error: Path) -> None:
    """Wait for GO, do the work between the marks, say how it ended; never returns."""
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

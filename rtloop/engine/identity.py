"""Which process a number means: the one that started at a moment, and no other that has the number later."""

from __future__ import annotations

import os
import signal
from pathlib import Path

START_TIME = 19
"""Of /proc/PID/stat, counted after the process's name (proc(5): field 22)."""


def start_time(pid: int) -> int | None:
    """When a process started, in clock ticks since boot; None where there is none of this number."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return None
    return int(status.rpartition(")")[2].split()[START_TIME])


def kill(pid: int, started: int) -> bool:
    """SIGKILL to the process `pid` that started at `started`; False where it is gone. Raises PermissionError.

    The descriptor means one process for good, so that what it is looked at for is what is killed.
    """
    if pid <= 0 or start_time(pid) is None:
        return False
    try:
        fd = os.pidfd_open(pid)
    except ProcessLookupError:
        return False
    try:
        if start_time(pid) != started:
            return False
        signal.pidfd_send_signal(fd, signal.SIGKILL)
        return True
    except ProcessLookupError:
        return False
    finally:
        os.close(fd)

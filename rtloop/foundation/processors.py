"""The processors that this process may use, and the processor time of processes."""

from __future__ import annotations

import os
import time

PROCESS_CLOCK = 2
"""Lowest bits of the kernel's number of a process's processor clock, as in clock_getcpuclockid of the C library."""


def usable_processors() -> int:
    """Return the number of processors on which this process may run; of all if the system does not tell."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor_time_s(pid: int) -> float:
    """Return the processor time that all threads of process `pid` have used, in s; 0 without such a process."""
    try:
        return time.clock_gettime(~pid << 3 | PROCESS_CLOCK)
    except OSError:
        return 0.0

"""The processors that this process may use."""

from __future__ import annotations

import os


def usable_processors() -> int:
    """Return the number of processors on which this process may run; of all if the system does not tell."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

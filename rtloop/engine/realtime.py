"""Privileges of a real-time process: each is requested from the host and reported as granted or refused."""

from __future__ import annotations

import ctypes
import gc
import os
import platform
from collections.abc import Callable
from typing import Any

from rtloop.engine.plan import Pacing

PR_SET_PDEATHSIG, PR_SET_TIMERSLACK = 1, 29
MCL_CURRENT, MCL_FUTURE = 1, 2
PM_QOS_DEVICE = "/dev/cpu_dma_latency"
_libc = ctypes.CDLL(None, use_errno=True)


def prepare_realtime(pacing: Pacing) -> dict[str, Any]:
    """Request all privileges that keep ticks on time, for the calling thread and its process; request none if unpaced.

    Returns the settings after that: `scheduler` ("SCHED_FIFO" or "SCHED_OTHER"), `priority` (0 for SCHED_OTHER),
    `mlock` and `pm_qos` (booleans), `affinity` (list of processors), `kernel` (text), `timer_slack_ns` (1, or None if
    it was not set), and `refused` (list of messages, one for each refused request). A refusal raises no error.
    """
    report: dict[str, Any] = {
        "scheduler": "SCHED_OTHER",
        "priority": 0,
        "mlock": False,
        "affinity": sorted(os.sched_getaffinity(0)),
        "kernel": f"{platform.release()} {platform.version()}",
        "timer_slack_ns": None,
        "pm_qos": False,
        "refused": [],
    }
    if not pacing.paced:
        return report
    _request(report, "affinity", lambda: _set_affinity(pacing.cpu))
    _request(report, "mlock", lambda: _require_success(_libc.mlockall(MCL_CURRENT | MCL_FUTURE)) or True)
    _request(report, "timer_slack_ns", lambda: _require_success(_libc.prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)) or 1)
    _request(report, "pm_qos", _request_pm_qos)
    _request(report, "priority", lambda: _enter_fifo(pacing.priority))
    if report["priority"]:
        report["scheduler"] = "SCHED_FIFO"
    return report


def freeze_garbage_collection() -> None:
    """Collect garbage, freeze the objects that remain (gc.freeze), and disable collection until the process ends."""
    gc.collect()
    gc.freeze()
    gc.disable()


def die_with_parent() -> None:
    """Let the kernel kill this process (SIGKILL) when its parent ends; a refusal is ignored.

    For virtual time alone: the outputs are not ramped down.
    """
    _libc.prctl(PR_SET_PDEATHSIG, 9, 0, 0, 0)


def _request(report: dict[str, Any], name: str, request: Callable[[], object]) -> None:
    """Call `request` and store its result in `report[name]`.

    An OSError leaves the old value, and adds the message "NAME: CAUSE" to the list `report["refused"]`.
    """
    try:
        report[name] = request()
    except OSError as error:
        report["refused"].append(f"{name}: {os.strerror(error.errno or 0)}")


def _require_success(result: int) -> int:
    """Return 0, the result of a C function. Raises OSError, with the C library's errno, for any other result."""
    if result != 0:
        raise OSError(ctypes.get_errno(), "refused")
    return result


def _set_affinity(cpu: int | None) -> list[int]:
    """Pin the thread to processor `cpu`, unless it is None; return the thread's processors, ascending.

    Raises OSError if refused.
    """
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    return sorted(os.sched_getaffinity(0))


def _enter_fifo(priority: int) -> int:
    """Schedule the thread as SCHED_FIFO with this priority and return it. Raises OSError if refused."""
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    return priority


def _request_pm_qos() -> bool:
    """Keep the processors out of deep idle states while this process lives, by a file that stays open; return True.

    Raises OSError if refused.
    """
    fd = os.open(PM_QOS_DEVICE, os.O_WRONLY | os.O_CLOEXEC)
    os.write(fd, (0).to_bytes(4, "little"))
    return True

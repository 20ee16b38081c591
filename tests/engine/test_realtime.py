"""Privileges of the loop's process: the report agrees with the kernel's values for that process."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys

import pytest

PROGRAM = """
import ctypes, json, os, sys
from rtloop.engine.plan import Pacing
from rtloop.engine.realtime import prepare_realtime
report = prepare_realtime(Pacing(rate_hz=1000.0, **json.loads(sys.argv[1])))
slack_ns = ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)  # PR_GET_TIMERSLACK
locked = [int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmLck")]
kernel = {"affinity": sorted(os.sched_getaffinity(0)), "slack_ns": slack_ns, "locked": locked[0] > 0,
          "policy": os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, "priority": os.sched_getparam(0).sched_priority}
print(json.dumps([report, kernel]))
"""
CPU = max(os.sched_getaffinity(0))


def prepare_process(**pacing):
    """Prepare a new process for real time; return its report and the kernel's values for it, both dicts."""
    result = subprocess.run([sys.executable, "-c", PROGRAM, json.dumps(pacing)], capture_output=True, check=True)
    return json.loads(result.stdout)


def test_the_report_of_a_paced_loop_is_what_the_kernel_says():
    report, kernel = prepare_process(cpu=CPU, priority=3)
    assert report["affinity"] == kernel["affinity"] == [CPU]
    assert report["mlock"] is kernel["locked"]
    granted = report["scheduler"] == "SCHED_FIFO"
    assert report["timer_slack_ns"] == 1
    assert kernel["slack_ns"] in ((0, 1) if granted else (1,))  # newer kernels show 0 for a real-time thread
    assert (report["priority"], kernel["priority"]) == ((3, 3) if granted else (0, 0))
    assert kernel["policy"] == (os.SCHED_FIFO if granted else os.SCHED_OTHER)
    refused = {entry.partition(":")[0] for entry in report["refused"]}
    assert refused == {
        *(["mlock"] if not kernel["locked"] else []),
        *(["priority"] if not granted else []),
        *(["pm_qos"] if not report["pm_qos"] else []),
    }


def test_a_processor_that_is_not_there_is_refused_and_nothing_else_for_it():
    report, kernel = prepare_process(cpu=1023)
    assert report["affinity"] == kernel["affinity"] == sorted(os.sched_getaffinity(0))
    assert "affinity: Invalid argument" in report["refused"]


def test_virtual_time_asks_for_nothing():
    report, kernel = prepare_process(paced=False, cpu=CPU)
    assert report["affinity"] == kernel["affinity"] == sorted(os.sched_getaffinity(0))
    assert (report["timer_slack_ns"], report["refused"], report["priority"]) == (None, [], 0)
    assert kernel["slack_ns"] != 1
    assert not kernel["locked"]


def test_a_refusal_of_the_c_library_has_its_reason():
    from rtloop.engine import realtime

    with pytest.raises(OSError, match="refused") as refusal:
        realtime._require_success(realtime._libc.prctl(realtime.PR_SET_PDEATHSIG, 999, 0, 0, 0))
    assert refusal.value.errno == errno.EINVAL

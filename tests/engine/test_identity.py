"""A process is its number and the moment it started: what has the number later is not it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

from rtloop.engine.identity import kill, start_time

SLEEPER = [sys.executable, "-c", "import sys; sys.stdin.read()"]


def test_the_start_is_that_of_the_process():
    """The kernel's count of clock ticks since boot, bracketed by our own look at its clock."""
    tick_s = 1 / os.sysconf("SC_CLK_TCK")
    before_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    with subprocess.Popen(SLEEPER, stdin=subprocess.PIPE) as process:
        after_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        started = start_time(process.pid)
        assert started is not None
        assert before_s - tick_s <= started * tick_s <= after_s + tick_s
        assert start_time(process.pid) == started


def test_a_name_may_hold_brackets(tmp_path):
    strange = tmp_path / "a) R 1 (b"
    strange.symlink_to(sys.executable)
    with subprocess.Popen([strange, *SLEEPER[1:]], stdin=subprocess.PIPE) as process:
        own = start_time(os.getpid())
        started = start_time(process.pid)
        assert started is not None
        assert own is not None
        assert started >= own


def test_only_the_process_that_is_meant_is_killed():
    with subprocess.Popen(SLEEPER, stdin=subprocess.PIPE) as process:
        started = start_time(process.pid)
        assert started is not None
        assert not kill(process.pid, started + 1)
        assert not kill(process.pid, 0)
        assert process.poll() is None
        assert kill(process.pid, started)
        assert process.wait() == -signal.SIGKILL
        assert not kill(process.pid, started)
        assert start_time(process.pid) is None


def test_what_is_no_process_is_not_killed():
    for pid in (0, -1, 2**40, 2**64 - 1):
        assert start_time(pid) is None
        assert not kill(pid, 0)

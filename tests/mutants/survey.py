"""A plug-in of pytest that records the lines and the duration of each test of a room, in the code without mistakes."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import coverage
import pytest

from tests.mutants.steady import DeterministicTests

CPU_LIMIT_S, COMPILED_CPU_LIMIT_S = 2.0, 20.0
"""Limits of processor time of a traced test, with uncompiled and with compiled kernels; slower ones are left out."""
COVERAGE = str(Path(coverage.__file__).parent)
SHARED = "shared"
"""Name, in place of a test's, under which the lines of a file's fixtures with a wider scope are recorded."""


class TooLong(BaseException):
    """A test exceeded its limit of processor time."""


class Survey(DeterministicTests):
    """Records the duration and the executed lines of every test that passes."""

    def __init__(self, root: Path, *, compiled: bool) -> None:
        super().__init__(compiled=compiled)
        self.root = root
        self._limit_s = COMPILED_CPU_LIMIT_S if compiled else CPU_LIMIT_S
        self.seconds: dict[str, float] = {}
        self.failed: dict[str, str] = {}
        self.starting: set[str] = set()
        """Tests that start processes; the lines executed there are not recorded."""
        self._coverage = coverage.Coverage(
            data_file=None, config_file=False, include=[f"{root}/{place}/*" for place in ("rtloop", "hil", "drivers")]
        )
        self._too_long: set[str] = set()
        """Test functions with a case that took too long; their other cases are skipped."""
        self._current = ""
        self._watch_processes()
        signal.signal(signal.SIGPROF, _raise_too_long)
        self._coverage.start()

    def _watch_processes(self) -> None:
        """Add the current test to `starting` whenever a process is started."""
        start = subprocess.Popen.__init__

        def start_and_record(popen: Any, *arguments: Any, **options: Any) -> None:
            self.starting.add(self._current)
            start(popen, *arguments, **options)

        subprocess.Popen.__init__ = start_and_record

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Record the lines and the duration of a test under its name."""
        self._coverage.switch_context(item.nodeid)
        self._current, start = item.nodeid, time.monotonic()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = time.monotonic() - start
            self._coverage.switch_context("")

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Skip a case if another case of its function took too long."""
        if item.nodeid.partition("[")[0] in self._too_long:
            pytest.skip("another case was too long")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        """Fail a test that exceeds the limit of processor time."""
        signal.setitimer(signal.ITIMER_PROF, self._limit_s, self._limit_s / 10)  # A callback may swallow the first.
        try:
            return (yield)
        except TooLong:
            self._too_long.add(item.nodeid.partition("[")[0])
            pytest.fail("too long")
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Iterator[None]:
        """Record the lines of a fixture with a wider scope than a function for all tests of its file."""
        if fixturedef.scope == "function":
            return (yield)
        item = request._pyfuncitem.nodeid
        self._coverage.switch_context(f"{item.partition('::')[0]}::{SHARED}")
        try:
            return (yield)
        finally:
            self._coverage.switch_context(item)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Record the reason why a test failed or was skipped."""
        if report.outcome != "passed":
            self.failed[report.nodeid] = str(report.longrepr)[-400:]

    def result(self) -> dict[str, Any]:
        """Return durations of passed tests, reasons of the others, tests that start processes, and lines by file."""
        self._coverage.stop()
        data = self._coverage.get_data()
        lines: dict[str, dict[str, list[int]]] = {}
        for file in data.measured_files():
            path = os.path.relpath(file, self.root)
            for line, contexts in data.contexts_by_lineno(file).items():
                for context in contexts:
                    lines.setdefault(context, {}).setdefault(path, []).append(line)
        passed = {name: seconds for name, seconds in self.seconds.items() if name not in self.failed}
        return {
            "seconds": passed,
            "failed": self.failed,
            "starting": sorted(self.starting),
            "lines": {name: lines[name] for name in sorted(lines) if name},
        }


def _raise_too_long(_: int, frame: FrameType | None) -> None:
    """Raise TooLong, except within coverage, which would never release its lock; the timer repeats the signal."""
    if frame is not None and frame.f_code.co_filename.startswith(COVERAGE):
        return
    raise TooLong("the test exceeded its limit of processor time")

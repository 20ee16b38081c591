"""A trial: plant a mutant in a copy of the tree, run its tests up to the first failure, and restore the source."""

from __future__ import annotations

import os
import re
import time
from contextlib import suppress
from pathlib import Path

import pytest

from tests.mutants.account import Result, Verdict
from tests.mutants.mutant import Mutant
from tests.mutants.rooms import ROOMS
from tests.mutants.steady import OPTIONS, DeterministicTests
from tests.mutants.trees import NOT_RUN, TIMED_OUT, Tree, poll_process

DURATION_FACTOR, EXTRA_S, COMPILER_S = 3.0, 30.0, 180.0
"""Limit of a trial: a factor on its tests' usual duration, a constant, and time to compile changed kernels."""
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


class Trial:
    """A mutant whose tests run on `text`, its changed module; call `result` until it returns a result."""

    def __init__(
        self, tree: Tree, mutant: Mutant, text: str, tests: dict[str, float], *, compiled: bool, second: bool = False
    ) -> None:
        self.mutant, self.second = mutant, second
        self._tree, self._began = tree, time.monotonic()
        compiler_s = COMPILER_S if compiled and not ROOMS[mutant.room].compiled else 0
        self._limit_s = DURATION_FACTOR * sum(tests.values()) + EXTRA_S + compiler_s
        self._path = tree.root / mutant.file
        self._source, self._stamp = self._path.read_text(encoding="utf-8"), self._path.stat()
        self._child = 0
        if tests:
            self._plant(text)
            arguments = [*OPTIONS, "-x", "-rfE", *tests]
            self._child = tree.start(
                lambda: int(pytest.main(arguments, plugins=[DeterministicTests(compiled=compiled)])), compiled=compiled
            )

    def _plant(self, text: str) -> None:
        """Write the changed module, with a later time stamp and without byte-code."""
        self._path.write_text(text, encoding="utf-8")
        os.utime(self._path, (self._stamp.st_atime + 10, self._stamp.st_mtime + 10))  # No byte-code fits it.
        _forget_bytecode(self._path)

    def result(self) -> Result | None:
        """Return the result and restore the source once the tests have ended; None while they run."""
        if not self._child:
            return Result(self.mutant.key, Verdict.UNTESTED, 0.0, "")
        code = poll_process(self._child, self._began + self._limit_s)
        if code is None:
            return None
        self._path.write_text(self._source, encoding="utf-8")
        os.utime(self._path, ns=(self._stamp.st_atime_ns, self._stamp.st_mtime_ns))
        return Result(self.mutant.key, *_evaluate(code, self._tree.output(), time.monotonic() - self._began))


def _evaluate(code: int, output: str, seconds: float) -> tuple[Verdict, float, str]:
    """Return verdict, seconds and the test that failed. Raises RuntimeError if the tests could not be run."""
    unknown = code == pytest.ExitCode.USAGE_ERROR and "ERROR collecting" not in output
    if code in (NOT_RUN, pytest.ExitCode.NO_TESTS_COLLECTED) or unknown:
        raise RuntimeError(f"tests of a mutant: exit code is {code}; allowed: 0, 1, 2\n{output[-2000:]}")
    if code == TIMED_OUT:
        return Verdict.TIMED_OUT, seconds, ""
    if code == pytest.ExitCode.OK:
        return Verdict.SURVIVED, seconds, ""
    failed = _FAILED.search(output)
    return Verdict.DIED, seconds, failed[1] if failed else output.strip()[-200:]


def _forget_bytecode(path: Path) -> None:
    """Delete the stored byte-code of a module."""
    for cached in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        with suppress(FileNotFoundError):
            cached.unlink()

"""One mutant at a time in a copy of the tree: planted, its tests run to the first that fails, and taken out again."""

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
from tests.mutants.steady import OPTIONS, Steady
from tests.mutants.trees import NOT_RUN, TIMED_OUT, Tree, ended

TIMES, MORE_S, COMPILER_S = 3.0, 30.0, 180.0
"""A mutant may take so many times as long as its tests without it, and so much more; kernels may be compiled anew."""
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


class Trial:
    """A mutant whose tests run: the module with its mistake is `text`; to be asked until there is a result."""

    def __init__(
        self, tree: Tree, mutant: Mutant, text: str, tests: dict[str, float], *, compiled: bool, second: bool = False
    ) -> None:
        self.mutant, self.second = mutant, second
        self._tree, self._began = tree, time.monotonic()
        self._limit_s = (
            TIMES * sum(tests.values()) + MORE_S + (COMPILER_S if compiled and not ROOMS[mutant.room].compiled else 0)
        )
        self._path = tree.root / mutant.file
        self._source, self._stamp = self._path.read_text(encoding="utf-8"), self._path.stat()
        self._child = 0
        if tests:
            self._plant(text)
            arguments = [*OPTIONS, "-x", "-rfE", *tests]
            self._child = tree.start(
                lambda: int(pytest.main(arguments, plugins=[Steady(compiled=compiled)])), compiled=compiled
            )

    def _plant(self, text: str) -> None:
        """Write the module with its mistake."""
        self._path.write_text(text, encoding="utf-8")
        os.utime(self._path, (self._stamp.st_atime + 10, self._stamp.st_mtime + 10))  # so that no byte-code is of it
        _forget_bytecode(self._path)

    def result(self) -> Result | None:
        """None while the tests run."""
        if not self._child:
            return Result(self.mutant.key, Verdict.UNTESTED, 0.0, "")
        code = ended(self._child, self._began + self._limit_s)
        if code is None:
            return None
        self._path.write_text(self._source, encoding="utf-8")
        os.utime(self._path, ns=(self._stamp.st_atime_ns, self._stamp.st_mtime_ns))
        return Result(self.mutant.key, *_judged(code, self._tree.output(), time.monotonic() - self._began))


def _judged(code: int, output: str, seconds: float) -> tuple[Verdict, float, str]:
    """Verdict, seconds and the test that failed. Raises RuntimeError where the tests could not be run at all."""
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
    for cached in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        with suppress(FileNotFoundError):
            cached.unlink()

"""Plant each mistake in a copy of the tree and run the tests that must fail: `make soak NAME=planted`.

Exit code 0 only if every selected mistake died: each of its tests passed without the mistake and failed with it.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.planted.mistakes import ROOT, Mistake, all_mistakes

TESTS_LIMIT_S = 1200.0
"""Limit for the tests of one mistake."""
ALL_PASSED, SOME_FAILED = 0, 1
"""Exit codes of pytest: all tests passed; some failed. After any other code the tests did not run."""


class Tree:
    """A copy of the working tree in a folder, with a separate cache of compiled code."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "tree"
        file_names = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT, check=True, capture_output=True, text=True,
        ).stdout  # fmt: skip
        for name in filter(None, file_names.split("\0")):
            if os.path.lexists(ROOT / name):
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, self.root / name, follow_symlinks=False)
        self._environment = {
            **os.environ, "PYTHONPATH": str(self.root), "XDG_CACHE_HOME": str(folder / "cache"), "TMPDIR": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",
        }  # fmt: skip
        module_file = self._run([sys.executable, "-c", "import rtloop; print(rtloop.__file__)"], False)[1].strip()
        if not Path(module_file).is_relative_to(self.root):
            raise SystemExit(f"the tests of the copy import another rtloop: {module_file}")

    def failures(self, tests: Sequence[str], uncompiled: bool) -> tuple[int, list[str]]:
        """Return pytest's exit code on `tests` (-1 if it exceeded TESTS_LIMIT_S) and the node ids that failed."""
        code, output = self._run(
            [sys.executable, "-m", "pytest", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider", *tests], uncompiled
        )
        lines = (line.split(" ", 2) for line in output.splitlines())
        return code, [line[1] for line in lines if line[0] in ("FAILED", "ERROR") and len(line) > 1]

    def _run(self, command: list[str], uncompiled: bool) -> tuple[int, str]:
        """Run a command in the tree; return exit code and output, (-1, "") if it exceeded TESTS_LIMIT_S."""
        environment = self._environment | ({"NUMBA_DISABLE_JIT": "1"} if uncompiled else {})
        process = subprocess.Popen(
            command, cwd=self.root, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            start_new_session=True,
        )  # fmt: skip
        try:
            output, _ = process.communicate(timeout=TESTS_LIMIT_S)
            return process.returncode, output
        except subprocess.TimeoutExpired:
            return -1, ""
        finally:
            _end_session(process)

    def verdict(self, mistake: Mistake) -> str:
        """Plant a mistake, run its tests, restore the file; return `died`, or the reason why it did not die."""
        path = self.root / mistake.file
        before = path.read_bytes()
        mistake.plant(self.root)
        try:
            code, failed_tests = self.failures(mistake.tests, mistake.uncompiled)
        finally:
            path.write_bytes(before)
        if code not in (ALL_PASSED, SOME_FAILED):
            return "HUNG" if code == -1 else f"BROKEN: its tests did not run (pytest ended with {code})"
        passed_tests = [test for test in mistake.tests if not any(name.startswith(test) for name in failed_tests)]
        return f"SURVIVED: passed: {', '.join(passed_tests)}" if passed_tests else "died"


def _end_session(process: subprocess.Popen[str]) -> None:
    """Kill the processes that the tests left running."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def failures_without_mistakes(tree: Tree, mistakes: Sequence[Mistake]) -> list[str]:
    """Return the tests of `mistakes` that fail in the unchanged tree, and a line for each run that did not complete."""
    failed_tests = []
    for uncompiled in (False, True):
        group = [mistake for mistake in mistakes if mistake.uncompiled == uncompiled]
        tests = dict.fromkeys(test for mistake in group for test in mistake.tests)
        if tests:
            code, failed = tree.failures(list(tests), uncompiled)
            failed_tests += failed
            if code not in (ALL_PASSED, SOME_FAILED):
                failed_tests.append(f"pytest ended with {code} on {', '.join(tests)}")
    return failed_tests


def main() -> int:
    """Try all mistakes, or those in whose name or file one of the words occurs; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*")
    words = parser.parse_args().words
    selected = all_mistakes()
    if words:
        selected = [m for m in selected if any(word in f"{m.name} {m.file}" for word in words)]
    stale = {mistake.name: fault for mistake in selected if (fault := mistake.fault())}
    for name, fault in stale.items():
        print(f"STALE     {name}: {fault}")
    plantable = [mistake for mistake in selected if mistake.name not in stale]
    died = 0
    with tempfile.TemporaryDirectory(prefix="rtloop-planted-", ignore_cleanup_errors=True) as folder:
        tree = Tree(Path(folder))
        if failed_tests := failures_without_mistakes(tree, plantable):
            print("tests fail without any mistake, so that no mistake can be tried:", *failed_tests, sep="\n  ")
            return 1
        for mistake in plantable:
            began_s = time.monotonic()
            verdict = tree.verdict(mistake)
            died += verdict == "died"
            print(f"{time.monotonic() - began_s:6.1f} s  {mistake.name}: {verdict}", flush=True)
    print(f"{died} of {len(selected)} died")
    return 0 if died == len(selected) > 0 else 1


if __name__ == "__main__":
    sys.exit(main())

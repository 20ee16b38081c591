"""Plant each mistake in a copy of the tree and run the tests that must go red: `make soak NAME=planted`.

Exit code 0 only if every chosen mistake died: each of its tests was green without it and red with it.
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

LONGEST_S = 1200.0
"""For the tests of one mistake."""
GREEN, RED = 0, 1
"""Exit codes of pytest: all tests passed; some failed. With any other one the tests did not run."""


class Tree:
    """A copy of the working tree in a folder of its own, with a cache of compiled code of its own."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "tree"
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT, check=True, capture_output=True, text=True,
        ).stdout  # fmt: skip
        for name in filter(None, listed.split("\0")):
            if os.path.lexists(ROOT / name):
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, self.root / name, follow_symlinks=False)
        self._environment = {
            **os.environ, "PYTHONPATH": str(self.root), "XDG_CACHE_HOME": str(folder / "cache"), "TMPDIR": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",
        }  # fmt: skip
        where = self._run([sys.executable, "-c", "import rtloop; print(rtloop.__file__)"], False)[1].strip()
        if not Path(where).is_relative_to(self.root):
            raise SystemExit(f"the copy is not what its tests import: {where}")

    def failures(self, tests: Sequence[str], uncompiled: bool) -> tuple[int, list[str]]:
        """Exit code of pytest on `tests`, and the node ids that failed; code -1 where it took longer than LONGEST_S."""
        code, output = self._run(
            [sys.executable, "-m", "pytest", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider", *tests], uncompiled
        )
        lines = (line.split(" ", 2) for line in output.splitlines())
        return code, [line[1] for line in lines if line[0] in ("FAILED", "ERROR") and len(line) > 1]

    def _run(self, command: list[str], uncompiled: bool) -> tuple[int, str]:
        environment = self._environment | ({"NUMBA_DISABLE_JIT": "1"} if uncompiled else {})
        process = subprocess.Popen(
            command, cwd=self.root, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            start_new_session=True,
        )  # fmt: skip
        try:
            output, _ = process.communicate(timeout=LONGEST_S)
            return process.returncode, output
        except subprocess.TimeoutExpired:
            return -1, ""
        finally:
            _end_session(process)

    def verdict(self, mistake: Mistake) -> str:
        """`died`, or why it did not; the tree is as before afterwards."""
        path = self.root / mistake.file
        before = path.read_bytes()
        mistake.plant(self.root)
        try:
            code, red = self.failures(mistake.tests, mistake.uncompiled)
        finally:
            path.write_bytes(before)
        if code not in (GREEN, RED):
            return "HUNG" if code == -1 else f"BROKEN: its tests did not run (pytest ended with {code})"
        green = [test for test in mistake.tests if not any(name.startswith(test) for name in red)]
        return f"SURVIVED: green is {', '.join(green)}" if green else "died"


def _end_session(process: subprocess.Popen[str]) -> None:
    """End what the tests started and left behind."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def red_without(tree: Tree, mistakes: Sequence[Mistake]) -> list[str]:
    """Tests that fail in the tree as it is, of those that the mistakes name."""
    red = []
    for uncompiled in (False, True):
        tests = dict.fromkeys(test for one in mistakes if one.uncompiled == uncompiled for test in one.tests)
        if tests:
            code, failed = tree.failures(list(tests), uncompiled)
            red += failed
            if code not in (GREEN, RED):
                red.append(f"pytest ended with {code} on {', '.join(tests)}")
    return red


def main() -> int:
    """All mistakes, or those in whose name or file one of the words occurs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*")
    words = parser.parse_args().words
    chosen = [one for one in all_mistakes() if not words or any(word in f"{one.name} {one.file}" for word in words)]
    stale = {one.name: fault for one in chosen if (fault := one.fault())}
    for name, fault in stale.items():
        print(f"STALE     {name}: {fault}")
    planted = [one for one in chosen if one.name not in stale]
    died = 0
    with tempfile.TemporaryDirectory(prefix="rtloop-planted-", ignore_cleanup_errors=True) as folder:
        tree = Tree(Path(folder))
        if red := red_without(tree, planted):
            print("red without any mistake, so that nothing can be said:", *red, sep="\n  ")
            return 1
        for one in planted:
            began_s = time.monotonic()
            verdict = tree.verdict(one)
            died += verdict == "died"
            print(f"{time.monotonic() - began_s:6.1f} s  {one.name}: {verdict}", flush=True)
    print(f"{died} of {len(chosen)} died")
    return 0 if died == len(chosen) > 0 else 1


if __name__ == "__main__":
    sys.exit(main())

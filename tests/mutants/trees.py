"""Copies of the project in which mutants are planted, and forked processes that run tests there."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tests.mutants.rooms import ROOT

NOT_COPIED = frozenset((".git", ".venv", "build", "dist", ".benchmarks", "recordings"))
"""Entries of the project's folder that are not copied, because they are no sources."""
PRELOADED = (
    *("numpy", "scipy.signal", "scipy.linalg", "scipy.optimize", "pydantic", "pytest", "_pytest.runner", "hypothesis"),
    *(
        "click",
        "rich.console",
        "rich.table",
        "starlette.applications",
        "uvicorn",
        "mcap.reader",
        "zstandard",
        "lz4.frame",
    ),
    *(
        "tomlkit",
        "jinja2",
        "prometheus_client",
        "websockets",
        "llvmlite.binding",
        "coverage",
        "xdist",
        "pytest_timeout",
    ),
)
"""Third-party modules that most tests need: imported once, by the process that is forked for each mutant."""
TIMED_OUT, NOT_RUN = -100, 70
"""Exit codes of a test process beside those of pytest and of signals."""


def preload() -> None:
    """Import PRELOADED, so that forked processes need not."""
    for name in PRELOADED:
        importlib.import_module(name)
    gc.freeze()


def _names_left_out(source: Path, folder: str, names: list[str]) -> set[str]:
    """Return the names in `folder` that a copy of `source` leaves out."""
    left_out = NOT_COPIED if Path(folder) == source else frozenset[str]()
    return {name for name in names if name in left_out or name == "__pycache__" or name.endswith(".egg-info")}


class Tree:
    """A copy of the project with a separate cache of compiled code, in `folder`."""

    def __init__(self, folder: Path, source: Path = ROOT) -> None:
        self.root, self._cache, self._output = folder / "tree", folder / "cache", folder / "output"
        self._scratch = folder / "t"
        """Folder of the tests' temporary files; a killed test may leave a disk mounted there."""
        for place in (self._cache, self._scratch):
            place.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(self.root, ignore_errors=True)
        shutil.copytree(source, self.root, symlinks=True, ignore=partial(_names_left_out, source))

    def start(self, run: Callable[[], int], *, compiled: bool, writes_bytecode: bool = False) -> int:
        """Start a process that calls `run` in this tree and ends with its return value; return the process id."""
        child = os.fork()
        if child == 0:
            status = NOT_RUN
            try:
                self._enter(compiled=compiled, writes_bytecode=writes_bytecode)
                status = run()
            except BaseException:  # The parent reads the traceback in the output.
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        return child

    def start_warming(self) -> int:
        """Start a process that compiles all kernels into the tree's cache; return the process id."""

        def compile_all() -> int:
            return int(importlib.import_module("rtloop.cli.warm").main())

        return self.start(compile_all, compiled=True)

    def _enter(self, *, compiled: bool, writes_bytecode: bool) -> None:
        """Move this forked process into the tree: session, output, folder, environment, import path, modules."""
        os.setsid()
        output = os.open(self._output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        os.chdir(self.root)
        os.environ |= {"XDG_CACHE_HOME": str(self._cache), "PYTHONPATH": str(self.root), "OPENBLAS_NUM_THREADS": "1"}
        os.environ["PYTEST_DEBUG_TEMPROOT"] = str(self._scratch)
        os.environ.pop("NUMBA_DISABLE_JIT", None)
        if not compiled:
            os.environ["NUMBA_DISABLE_JIT"] = "1"
        if not writes_bytecode:  # The next mutant would load the byte-code of this one.
            sys.dont_write_bytecode, os.environ["PYTHONDONTWRITEBYTECODE"] = True, "1"
        sys.path[:] = [str(self.root), *(place for place in sys.path if place not in ("", str(ROOT)))]
        for name in [name for name in sys.modules if name.partition(".")[0] in ("tests", "rtloop")]:
            del sys.modules[name]

    def output(self) -> str:
        """Return the output of the last process."""
        return self._output.read_text(errors="replace")


def poll_process(child: int, deadline_s: float) -> int | None:
    """Return a process's exit code, None while it runs; after `deadline_s` kill it and its children: TIMED_OUT."""
    number, status = os.waitpid(child, os.WNOHANG)
    if number:
        _end_group(child)
        return os.waitstatus_to_exitcode(status)
    if time.monotonic() < deadline_s:
        return None
    _end_group(child)
    os.waitpid(child, 0)
    return TIMED_OUT


def _end_group(leader: int) -> None:
    """Kill a process and its children, if any are left."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGKILL)

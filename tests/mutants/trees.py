"""Copies of the tree, in which mutants are planted, and tests that run in them without a new interpreter."""

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
"""Entries of the project's folder that are no sources."""
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
"""Other people's modules that most tests import: once, by the process that is forked for each mutant."""
TIMED_OUT, NOT_RUN = -100, 70
"""Exit codes that neither pytest nor a signal gives."""


def preload() -> None:
    """Import what most tests need, and leave it to the processes that are forked."""
    for name in PRELOADED:
        importlib.import_module(name)
    gc.freeze()


def _names_left_out(source: Path, folder: str, names: list[str]) -> set[str]:
    """Return the names in `folder` that a copy of `source` leaves out."""
    left_out = NOT_COPIED if Path(folder) == source else frozenset[str]()
    return {name for name in names if name in left_out or name == "__pycache__" or name.endswith(".egg-info")}


class Tree:
    """A copy of the project with a cache of compiled code of its own, in `folder`."""

    def __init__(self, folder: Path, source: Path = ROOT) -> None:
        self.root, self._cache, self._output = folder / "tree", folder / "cache", folder / "output"
        self._scratch = folder / "t"
        """Folder of the tests' files: a test that was killed may leave a disk there that stays mounted."""
        for place in (self._cache, self._scratch):
            place.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(self.root, ignore_errors=True)
        shutil.copytree(source, self.root, symlinks=True, ignore=partial(_names_left_out, source))

    def start(self, run: Callable[[], int], *, compiled: bool, writes_bytecode: bool = False) -> int:
        """Number of a new process that calls `run` within this tree, and ends with what it returns."""
        child = os.fork()
        if child == 0:
            status = NOT_RUN
            try:
                self._enter(compiled=compiled, writes_bytecode=writes_bytecode)
                status = run()
            except BaseException:  # whatever it is, the parent reads of it
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        return child

    def start_warming(self) -> int:
        """Start a process that compiles all kernels into the tree's cache. Returns its number."""

        def compile_all() -> int:
            return int(importlib.import_module("rtloop.cli.warm").main())

        return self.start(compile_all, compiled=True)

    def _enter(self, *, compiled: bool, writes_bytecode: bool) -> None:
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
        if not writes_bytecode:  # of a mutated module it would be found by the next one, whose time stamp is the same
            sys.dont_write_bytecode, os.environ["PYTHONDONTWRITEBYTECODE"] = True, "1"
        sys.path[:] = [str(self.root), *(place for place in sys.path if place not in ("", str(ROOT)))]
        for name in [name for name in sys.modules if name.partition(".")[0] in ("tests", "rtloop")]:
            del sys.modules[name]

    def output(self) -> str:
        """What the last process wrote."""
        return self._output.read_text(errors="replace")


def ended(child: int, until: float) -> int | None:
    """Exit code of a process, or None while it runs; after `until` it is killed with its children: TIMED_OUT."""
    number, status = os.waitpid(child, os.WNOHANG)
    if number:
        _end_group(child)
        return os.waitstatus_to_exitcode(status)
    if time.monotonic() < until:
        return None
    _end_group(child)
    os.waitpid(child, 0)
    return TIMED_OUT


def _end_group(leader: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGKILL)

"""Forked children of a service, which need no second for their imports: the parent has imported all modules.

`subprocess.Popen` still does the rest: pipes, inherited descriptors, the wait for the start of the child.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from typing import Any

from rtloop.engine import process
from rtloop.engine.plan import Pacing
from rtloop.engine.realtime import prepare_realtime

_PASSED, _STDIN, _STDOUT = 3, 6, 9
"""Positions of arguments of `_posixsubprocess.fork_exec`."""


def fork_children() -> None:
    """Make this process start `python -m MODULE` by a fork instead of a new interpreter."""
    subprocess._fork_exec = _fork  # type: ignore[attr-defined]  # pyright: ignore[reportAttributeAccessIssue]


def _fork(command: list[bytes | str], *rest: Any) -> int:
    """Fork a child that runs MODULE with the descriptors that `fork_exec` would give it; return its process id."""
    arguments: tuple[Any, ...] = (command, *rest)
    if pid := os.fork():
        return pid
    code = 1
    try:
        os.dup2(arguments[_STDIN], 0)
        os.dup2(arguments[_STDOUT], 1)
        for fd in map(int, os.listdir("/proc/self/fd")):
            if fd > 2 and (fd not in arguments[_PASSED] or _is_error_pipe(fd, arguments)):
                with suppress(OSError):
                    os.close(fd)
        os.setpgid(0, 0)
        sys.stdin, sys.stdout = os.fdopen(0, closefd=False), os.fdopen(1, "w", closefd=False)
        words = [os.fsdecode(word) for word in command]
        module, *sys.argv[1:] = words[words.index("-m") + 1 :]
        process.prepare_realtime = _prepare_unpaced
        code = importlib.import_module(module).main()
        sys.stdout.flush()
    finally:
        os._exit(code)


def _is_error_pipe(fd: int, arguments: tuple[Any, ...]) -> bool:
    """Return whether `fd` is the pipe through which a child reports that it cannot start."""
    return fd in arguments[12:14]


def _prepare_unpaced(pacing: Pacing) -> dict[str, Any]:
    """Prepare a loop as an unpaced one: locking its memory would make a forked child copy all of it."""
    return prepare_realtime(replace(pacing, paced=False))

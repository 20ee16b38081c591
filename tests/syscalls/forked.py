"""Children of a service without the second that an interpreter takes to import: forked from what is imported already.

`subprocess.Popen` does all else as it does: pipes, descriptors that are handed on, the wait for the child's beginning.
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
"""Places of the arguments of `_posixsubprocess.fork_exec`."""


def without_imports() -> None:
    """From now on this process starts `python -m MODULE` by a fork."""
    subprocess._fork_exec = _fork  # type: ignore[attr-defined]  # pyright: ignore[reportAttributeAccessIssue]


def _fork(command: list[bytes | str], *rest: Any) -> int:
    """The process of `python -m MODULE ARGUMENTS`, whose descriptors are those of `fork_exec`."""
    arguments: tuple[Any, ...] = (command, *rest)
    if pid := os.fork():
        return pid
    code = 1
    try:
        os.dup2(arguments[_STDIN], 0)
        os.dup2(arguments[_STDOUT], 1)
        for fd in map(int, os.listdir("/proc/self/fd")):
            if fd > 2 and (fd not in arguments[_PASSED] or _leads_to_the_parent(fd, arguments)):
                with suppress(OSError):
                    os.close(fd)
        os.setpgid(0, 0)
        sys.stdin, sys.stdout = os.fdopen(0, closefd=False), os.fdopen(1, "w", closefd=False)
        module, *sys.argv[1:] = [os.fsdecode(word) for word in command[2:]]
        process.prepare_realtime = _ask_for_nothing
        code = importlib.import_module(module).main()
        sys.stdout.flush()
    finally:
        os._exit(code)


def _leads_to_the_parent(fd: int, arguments: tuple[Any, ...]) -> bool:
    """Whether it is the pipe by which a child says why it cannot begin."""
    return fd in arguments[12:14]


def _ask_for_nothing(pacing: Pacing) -> dict[str, Any]:
    """Whoever is forked would first copy all memory that it is to lock."""
    return prepare_realtime(replace(pacing, paced=False))

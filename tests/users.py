"""Two users of one machine, for tests that run as root: processes that become one of them."""

from __future__ import annotations

import os
import pickle
import shutil
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

VICTIM, ATTACKER = 54321, 54322
"""Users that no machine has."""
ROOT_ONLY = pytest.mark.skipif(os.geteuid() != 0, reason="becoming another user needs root")


class Raised(Exception):
    """An exception in another user's process: name of its type, message, exit code."""

    def __init__(self, name: str, message: str, exit_code: int | None) -> None:
        super().__init__(name, message, exit_code)
        self.name, self.message, self.exit_code = name, message, exit_code


def as_user(uid: int, function: Callable[[], Any], groups: tuple[int, ...] = ()) -> Any:
    """Call `function` in a process of user `uid` without a home; return its result. Its exception becomes Raised."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        with open(write, "wb") as answer:
            pickle.dump(_become_and_call(uid, function, groups), answer)
        os._exit(0)
    os.close(write)
    with open(read, "rb") as answer:
        data = answer.read()
    os.waitpid(pid, 0)
    has_returned, value = pickle.loads(data)
    if has_returned:
        return value
    raise value


def _become_and_call(uid: int, function: Callable[[], Any], groups: tuple[int, ...]) -> tuple[bool, Any]:
    os.setgroups(groups)
    os.setresgid(uid, uid, uid)
    os.setresuid(uid, uid, uid)
    for name in ("HOME", "XDG_CACHE_HOME", "RUNTIME_DIRECTORY"):
        os.environ.pop(name, None)
    try:
        return True, function()
    except Exception as error:
        message = str(error) if hasattr(error, "exit_code") or isinstance(error, OSError) else traceback.format_exc()
        return False, Raised(type(error).__name__, message, getattr(error, "exit_code", None))


@contextmanager
def clean_places() -> Iterator[Path]:
    """Yield the path of the victim's folder in /tmp, which does not exist before and after."""
    folder = Path(f"/tmp/rtloop-{VICTIM}")

    def remove() -> None:
        if folder.is_symlink():
            folder.unlink()
        shutil.rmtree(folder, ignore_errors=True)

    remove()
    try:
        yield folder
    finally:
        remove()

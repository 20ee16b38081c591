"""Read, print, export and plot a recording as on a system without the calls of Linux: `foreign_system.py FILE FOLDER`.

Modules and functions that Windows lacks are removed after the import of libraries and before the import of rtloop.
"""

from __future__ import annotations

import os
import sys
from importlib.abc import MetaPathFinder

MODULES = frozenset({"fcntl", "resource", "termios", "grp", "pwd", "tty", "pty", "_posixshmem"})
FUNCTIONS = (
    "sched_", "memfd_", "pidfd_", "eventfd", "posix_fa", "O_PATH", "O_NOFOLLOW", "O_CLOEXEC", "O_NONBLOCK", "O_NOCTTY",
    "O_DIRECTORY", "geteuid", "getegid", "getuid", "getgid", "getgroups", "fchown", "chown", "pwrite", "pread",
)  # fmt: skip
"""Prefixes of the names that Windows lacks in `os`."""


class MissingModules(MetaPathFinder):
    """Finder that refuses MODULES."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> None:
        """Raise ModuleNotFoundError for a module that the system does not have."""
        if fullname in MODULES:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)


def remove_linux() -> None:
    """Remove MODULES and FUNCTIONS from this process."""
    sys.meta_path.insert(0, MissingModules())
    for name in MODULES:
        sys.modules.pop(name, None)
    for name in [name for name in dir(os) if name.startswith(FUNCTIONS)]:
        delattr(os, name)


def main() -> None:
    """Print `ticks N`, then the outcome of each command."""
    import matplotlib.pyplot  # noqa: F401
    import numpy  # noqa: F401

    remove_linux()
    import rtloop
    from rtloop.cli import main as command

    recording, folder = sys.argv[1:]
    print("ticks", len(rtloop.load(recording)["tick"]))
    for words in (
        ["info"],
        ["export", "--to", "csv", "--out", f"{folder}/a.csv"],
        ["plot", "--out", f"{folder}/a.png"],
    ):
        try:
            command([words[0], recording, *words[1:]], standalone_mode=False)
            print("done", words[0])
        except SystemExit as end:
            print("done" if not end.code else f"exit code {end.code} of", words[0])


if __name__ == "__main__":
    main()

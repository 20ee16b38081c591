"""The command line as a program: independent of the surroundings it was started in, and with one way to end."""

from __future__ import annotations

import errno
import io
import os
import stat
import sys
import warnings
from typing import IO, Any

import click

from rtloop.errors import HostRefusal, OutputError
from rtloop.foundation.children import SAFE_PATH, harmful_variables

STREAMS = (("stdin", "r"), ("stdout", "w"), ("stderr", "w"))
OWNER_RIGHTS = stat.S_IRWXU
NOT_WRITTEN = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO)
"""Causes for which a file or stream cannot be written, in an OSError that no command has explained."""


class Program(click.Group):
    """The command `rtloop`. A call runs the process's command line; `main` of click runs given arguments alone."""

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        """Run the command line and end the process. An OSError that no command has explained becomes a sentence."""
        _prepare_streams()
        _prepare_environment()
        try:
            try:
                super().__call__(*args, **kwargs)
            finally:
                sys.stdout.flush()
        except BrokenPipeError:
            code = 1
        except OSError as error:
            code = OutputError.exit_code if error.errno in NOT_WRITTEN else HostRefusal.exit_code
            is_stream = error.filename is None and error.errno in NOT_WRITTEN
            place = f"{error.filename or 'standard output'}: " if error.filename or is_stream else ""
            _complain(f"rtloop: {place}{error.strerror or error}\n")
        else:
            return
        _discard_output()
        sys.exit(code)


def _prepare_streams() -> None:
    """Open the null device for closed standard streams, and print characters that a stream cannot encode as \\\\xb5.

    A file that is opened later would else become the standard output, into which libraries and children write.
    """
    for number, (name, mode) in enumerate(STREAMS):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest free number, which is this one
        stream: IO[str] | None = getattr(sys, name)
        if stream is None:
            stream = os.fdopen(number, mode, encoding="utf-8", closefd=False)
            setattr(sys, name, stream)
        if mode == "w" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _prepare_environment() -> None:
    """Remove what would change results or break commands from this process's environment, for its children too."""
    if ignored := [name for name in harmful_variables() if name.startswith("NUMBA_")]:
        _complain(f"warning: environment: {', '.join(ignored)}: no effect; rtloop compiles with its own settings\n")
    if sys.flags.optimize > 1:
        _complain("warning: environment: PYTHONOPTIMIZE=2: help and descriptions are missing; unset it\n")
    for name in harmful_variables():
        del os.environ[name]
    sys.warnoptions[:] = ["default"] if sys.flags.dev_mode else []  # multiprocessing passes them on, and removes this
    warnings.resetwarnings()
    warnings.simplefilter("ignore")
    os.environ |= SAFE_PATH | {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
    umask = os.umask(0o077)
    os.umask(umask & ~OWNER_RIGHTS)  # a file is of no use if not even its owner can read it


def _complain(line: str) -> None:
    """Write a line to stderr; no effect if that fails."""
    try:
        sys.stderr.write(line)
        sys.stderr.flush()
    except OSError:
        pass


def _discard_output() -> None:
    """Send what is still buffered for stdout and stderr to the null device, so that Python's exit does not fail."""
    null_fd = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):
        os.dup2(null_fd, number)

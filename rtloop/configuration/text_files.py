"""Reading files that a user names: regular files of a bounded size. Messages never quote their contents."""

from __future__ import annotations

import errno
import os
import re
import stat
import sys
import tomllib
from pathlib import Path
from typing import Any

from rtloop.errors import RtloopError
from rtloop.foundation.trusted import close_descriptor, open_user_file


class InputFileError(RtloopError):
    """The file is missing or unreadable."""

    exit_code = 66


MAX_TEXT_BYTES = 1 << 20
"""Size limit for a configuration or a specification."""
_READ = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
RECORDING = "a recording, not a text file; `rtloop info`, `rtloop replay` and `rtloop identify` read recordings"
_QUOTED = re.compile(r"""\(['"].*['"],?\)|(['"]).{2,}\1""", re.DOTALL)
"""Keys, or more than one character, that tomllib quotes in a message."""


def read_regular(path: Path, limit_bytes: int) -> bytes:
    """Return all of a regular file; links are followed.

    Raises OSError for a file that cannot be opened, another kind of file, and one of more than `limit_bytes`.
    """
    return _contents(open_user_file(path), limit_bytes)


def read_text(path: Path, refused: type[RtloopError] = InputFileError) -> str:
    """Return the contents of a text file in UTF-8.

    Raises `refused`, which names the file, if it cannot be read, has more than MAX_TEXT_BYTES or is no text in UTF-8.
    """
    try:
        return read_regular(path, MAX_TEXT_BYTES).decode()
    except OSError as error:
        fault = error.strerror
    except UnicodeDecodeError as error:
        fault = f"not a text file in UTF-8 (fault at byte {error.start})"
    raise refused(f"{path}: {RECORDING if _is_mcap(path) else fault}")


def _is_mcap(path: Path) -> bool:
    """Whether a file begins as a recording does; False where it cannot be opened."""
    from rtloop.recording.file.mcap.container import MAGIC  # needed after an error alone

    try:
        with os.fdopen(open_user_file(path), "rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def read_below(folder: Path, relative: Path, limit_bytes: int) -> bytes:
    """Return all of a regular file in or below `folder`, reached through no link.

    Raises OSError for a path out of the folder, a link, another kind of file, a larger one, and an unreadable one.
    """
    if relative.is_absolute() or ".." in relative.parts or not relative.parts:
        raise OSError(
            errno.EACCES, "the file is outside the configuration's folder; allowed: files in or below that folder"
        )
    fd = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for part in relative.parts[:-1]:
            parent_fd, fd = fd, os.open(part, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=fd)
            close_descriptor(parent_fd)
        return _contents(os.open(relative.name, _READ | os.O_NOFOLLOW, dir_fd=fd), limit_bytes)
    finally:
        close_descriptor(fd)


def _contents(fd: int, limit_bytes: int) -> bytes:
    """Return all that the descriptor `fd` holds, and close it.

    Raises OSError for another kind of file than a regular one, and for more than `limit_bytes`.
    """
    with os.fdopen(fd, "rb") as file:
        status = os.fstat(fd)
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a regular file")
        data = file.read(limit_bytes + 1)
        if len(data) > limit_bytes:
            size_bytes = max(status.st_size, len(data))
            raise OSError(errno.EFBIG, f"the file has {size_bytes} bytes; allowed: up to {limit_bytes} bytes")
        return data


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text. Raises ValueError, which does not quote the text beyond single characters."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not valid TOML: {_QUOTED.sub('…', str(error))}") from None
    except ValueError:  # the interpreter's own limit, whose message is about the interpreter
        raise ValueError(
            f"not valid TOML: an integer has more than {sys.get_int_max_str_digits()} digits; shorten it"
        ) from None
    except RecursionError:
        raise ValueError(
            "not valid TOML: lists or tables are nested too deeply (hundreds of levels); use fewer levels"
        ) from None

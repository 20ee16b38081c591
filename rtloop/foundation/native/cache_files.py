"""Files of the cache of compiled code: written atomically, and used only if their digest agrees.

Each file ends with the SHA-256 of its contents. A power cut may leave a file empty, cut short or full of zeros, and
running such contents could do anything.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import tempfile
from pathlib import Path

from rtloop.foundation.trusted import open_own

DIGEST_BYTES = hashlib.sha256().digest_size
MACHINE_CODE = ".o"
SUFFIXES = (MACHINE_CODE, ".nbi", ".nbc")
"""Suffixes of rtloop's machine code, of numba's index of a kernel's signatures, and of numba's compiled code."""
DAMAGED = ".damaged"
"""Suffix added to the name of a damaged file."""
STDERR = 2
_quarantined: list[Path] = []
"""Damaged files that this process has renamed."""


def write(path: Path, data: bytes) -> None:
    """Store a file atomically, with its digest. An error is ignored: the next process compiles the code again."""
    with contextlib.suppress(OSError), tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        try:
            file.write(data + hashlib.sha256(data).digest())
            file.flush()
            os.fsync(file.fileno())
            os.replace(file.name, path)
        except OSError:
            os.unlink(file.name)


def read(path: Path) -> bytes | None:
    """Return a file's contents without the digest; None if it is missing or damaged.

    A damaged file, and one that cannot be read or belongs to another user, is renamed; the first one in this process
    causes a warning on stderr.
    """
    try:
        data = _contents(path)
    except FileNotFoundError:
        return None
    except OSError:
        data = b""
    if not _is_whole(data):
        _quarantine(path)
        return None
    return data[:-DIGEST_BYTES]


def damaged_files(folder: Path) -> list[Path]:
    """Return the damaged files in or below `folder` that are not renamed; [] for a missing folder.

    Raises OSError for one that cannot be read.
    """
    files = [path for path in sorted(folder.rglob("*")) if path.suffix in SUFFIXES and path.is_file()]
    return [path for path in files if not _is_whole(_contents(path))]


def quarantined_files(folder: Path) -> list[Path]:
    """Return the damaged files in or below `folder` that any process has renamed."""
    return sorted(folder.rglob(f"*{DAMAGED}"))


def _contents(path: Path) -> bytes:
    """Return all bytes of a regular file, no link, of this user or root.

    Raises OSError if it is missing or another's.
    """
    with os.fdopen(open_own(path), "rb") as file:
        return file.read()


def _is_whole(data: bytes) -> bool:
    """Whether the last DIGEST_BYTES of `data` are the SHA-256 of the bytes before."""
    return hashlib.sha256(data[:-DIGEST_BYTES]).digest() == data[-DIGEST_BYTES:]


def _quarantine(path: Path) -> None:
    """Rename a damaged file to make room for a new one; the first one in a process causes a warning on stderr.

    An error of renaming is ignored.
    """
    with contextlib.suppress(OSError):
        os.replace(path, f"{path}{DAMAGED}")
    if not _quarantined:
        _warn(f"rtloop: the cache of compiled code is damaged: {path}; damaged files are renamed and compiled anew\n")
    _quarantined.append(path)


def _warn(line: str) -> None:
    """Write a line to stderr, or drop it if that would block: an output may be waiting to be parked."""
    with contextlib.suppress(OSError):
        if select.select([], [STDERR], [], 0)[1]:
            os.write(STDERR, line.encode(errors="replace"))

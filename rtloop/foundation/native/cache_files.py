"""Files of the cache of compiled code: written whole or not at all, and believed only where they are whole.

Each ends with the SHA-256 of what stands before it. A power cut may leave a file empty, cut short or full of zeros; to
run what it holds would be to run anything.
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
"""Of our machine code; of numba's index of what a kernel was compiled for, and of what came of it."""
DAMAGED = ".damaged"
"""Suffix of a file that is set aside."""
STDERR = 2
_quarantined: list[Path] = []
"""Files that this process has set aside."""


def write(path: Path, data: bytes) -> None:
    """Store a file whole. One that cannot be stored is left out: the next process compiles it again."""
    with contextlib.suppress(OSError), tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        try:
            file.write(data + hashlib.sha256(data).digest())
            file.flush()
            os.fsync(file.fileno())
            os.replace(file.name, path)
        except OSError:
            os.unlink(file.name)


def read(path: Path) -> bytes | None:
    """The contents of a file, without its digest; None where there is none, or a damaged one, which is set aside."""
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
    """Files in or below `folder` that are damaged, not yet found so by who reads them. Raises OSError."""
    files = [path for path in sorted(folder.rglob("*")) if path.suffix in SUFFIXES and path.is_file()]
    return [path for path in files if not _is_whole(_contents(path))]


def quarantined_files(folder: Path) -> list[Path]:
    """Files in or below `folder` that were damaged. Raises OSError."""
    return sorted(folder.rglob(f"*{DAMAGED}"))


def _contents(path: Path) -> bytes:
    """All bytes of a file of ours or root's. Raises OSError."""
    with os.fdopen(open_own(path), "rb") as file:
        return file.read()


def _is_whole(data: bytes) -> bool:
    return hashlib.sha256(data[:-DIGEST_BYTES]).digest() == data[-DIGEST_BYTES:]


def _quarantine(path: Path) -> None:
    """Rename a damaged file, so that a new one takes its place, and say so once in a process."""
    with contextlib.suppress(OSError):
        os.replace(path, f"{path}{DAMAGED}")
    if not _quarantined:
        _warn(f"rtloop: the cache of compiled code is damaged: {path}; damaged files are renamed and compiled anew\n")
    _quarantined.append(path)


def _warn(line: str) -> None:
    """Write a line to stderr, unless nobody reads there: an output may be waiting to be parked."""
    with contextlib.suppress(OSError):
        if select.select([], [STDERR], [], 0)[1]:
            os.write(STDERR, line.encode(errors="replace"))

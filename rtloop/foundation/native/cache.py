"""The folder of the cache of compiled code, one for each state of the sources.

numba checks only the file that defines a cached function: a loop that calls an edited law would keep running the old
law. The folder's name is therefore a digest of every source file that kernels may come from, of the compiler's version
and of the processor.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import llvmlite.binding

from rtloop.foundation.trusted import HAS_OWNERS, close_descriptor, open_folder

PACKAGE = Path(__file__).parents[2]
ROOMS = ("foundation", "hil", "drivers", "engine", "laws")
"""Rooms in which a file counts if it contains MARK: it imports what compiles, and so has kernels."""
MARK = b"foundation.native"
WHOLE = (
    *("kernel", "laws/shipped", "foundation/native"),
    *("drivers/node/card.py", "drivers/node/failures.py", "drivers/node/frames.py", "engine/messages.py"),
    *("hysteresis/play_model.py", "recording/file/topics/tick_kernels.py", "recording/replay/kernels.py", "signals.py"),
)
"""Folders and files that count whole: kernels use functions and constants of them."""
OPTIONS = "options.py"
"""Name of files with models of options, which do not count: no kernel uses them, and their help texts are edited often.
"""


def source_digest() -> str:
    """Return 24 hexadecimal digits of a digest of all `kernel_sources`, and of the versions of compiler and Python and
    the processor.
    """
    digest = hashlib.sha256()
    for name, text in kernel_sources():
        digest.update(name.encode() + b"\0" + text + b"\0")
    for fact in (installed_version("numba"), installed_version("llvmlite"), platform.python_version(), cpu_identity()):
        digest.update(fact.encode() + b"\0")
    return digest.hexdigest()[:24]


def kernel_sources() -> Iterator[tuple[str, bytes]]:
    """Yield path within the package and text of each file of which kernels, or what they use, may come."""
    whole = {PACKAGE / place for place in WHOLE}
    paths = {path for room in ROOMS for path in (PACKAGE / room).rglob("*.py")}
    for place in whole:
        paths.update(place.rglob("*.py") if place.is_dir() else [place])
    for path in sorted(paths):
        text = path.read_bytes()
        if path.name != OPTIONS and (MARK in text or not whole.isdisjoint((path, *path.parents))):
            yield path.relative_to(PACKAGE).as_posix(), text


def installed_version(package: str) -> str:
    """Return the version of an installed package from the name of its .dist-info folder; the package is not imported.

    If there is no such folder beside the package, or several, `importlib.metadata` looks for it, whose import takes
    longer than `source_digest`. Raises PackageNotFoundError for a package without metadata.
    """
    spec, ending = find_spec(package), ".dist-info"
    if spec is not None and spec.origin is not None:
        folders = [*Path(spec.origin).parents[1].glob(f"{package}-*{ending}")]
        if len(folders) == 1:
            return folders[0].name.removeprefix(f"{package}-").removesuffix(ending)
    from importlib.metadata import version

    return version(package)


def cpu_identity() -> str:
    """Return the processor's model and its instruction set, separated by a space, as LLVM names them."""
    return llvmlite.binding.get_host_cpu_name() + " " + llvmlite.binding.get_host_cpu_features().flatten()


def _make_private_folder(path: Path) -> bool:
    """Make the folder `path` if needed; return whether this user can write to it and no other user can.

    False, too, if it cannot be made.
    """
    try:
        close_descriptor(open_folder(path, 0o700))
    except OSError:
        return False
    return os.access(path, os.W_OK | os.X_OK)


def _cache_folder() -> tuple[Path, bool]:
    """Return the cache's folder, made if needed, and whether its files survive a restart of the machine.

    It is in the user's cache folder, whose files survive, else in the folder for temporary files, such as /tmp, else a
    new folder for this process alone.
    """
    if not HAS_OWNERS:  # A folder that others cannot change is not known to be one.
        return Path(tempfile.mkdtemp(prefix="rtloop-")), False
    digest = source_digest()
    home = os.environ.get("XDG_CACHE_HOME") or f"{os.environ.get('HOME', '')}/.cache"
    # A relative path would make any folder in which the process stands a place of code; without HOME there is no cache.
    if os.path.isabs(home) and home != "/.cache" and _make_private_folder(Path(home) / "rtloop" / digest):
        return Path(home) / "rtloop" / digest, True
    shared = Path(tempfile.gettempdir()) / f"rtloop-{os.getuid()}"
    if _make_private_folder(shared) and _make_private_folder(shared / digest):
        return shared / digest, False
    return Path(tempfile.mkdtemp(prefix="rtloop-")), False


CACHE_FOLDER, CACHE_IS_PERSISTENT = _cache_folder()
with contextlib.suppress(OSError):
    os.utime(CACHE_FOLDER)  # Installing another version deletes the folders that were not used for longest.


def stored_file_count() -> int:
    """Return the number of files in CACHE_FOLDER; every compiled function adds files. 0 if the folder is unreadable."""
    try:
        return len(os.listdir(CACHE_FOLDER))
    except OSError:
        return 0

"""The compiled loop and the libraries that it was compiled with."""

from __future__ import annotations

import platform
import shlex
from importlib.metadata import PackageNotFoundError, version

from rtloop.doctor.findings import Finding
from rtloop.doctor.host import Host
from rtloop.engine.plan import Pacing
from rtloop.foundation.children import python_command
from rtloop.foundation.native.cache import CACHE_FOLDER, CACHE_IS_PERSISTENT
from rtloop.foundation.native.cache_files import damaged_files, quarantined_files

LIBRARIES = ("rtloop", "numpy", "numba", "llvmlite", "scipy", "mcap")


def compiled_code(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on the cache of compiled code: good if it outlives a restart of the machine and has no damaged
    file.

    A bad value makes the start of a run slower; it makes no tick late. Raises OSError for a file of the cache that
    cannot be read.
    """
    cache_text = f"{CACHE_FOLDER}" if CACHE_IS_PERSISTENT else f"{CACHE_FOLDER}, gone after a restart"
    if damaged_count := len(damaged_files(CACHE_FOLDER)) + len(quarantined_files(CACHE_FOLDER)):
        return Finding(
            "compiled code",
            f"{cache_text}; {damaged_count} damaged files",
            "no damaged file",
            False,
            0.0,
            "the next start compiles damaged files again; if files are damaged repeatedly, the disk fails",
            shlex.join(python_command("rtloop.cli.warm")),
        )
    return Finding(
        "compiled code",
        cache_text,
        "a folder that outlives a restart",
        CACHE_IS_PERSISTENT,
        0.0,
        "the first start after each restart of the machine compiles for half a minute",
        "export XDG_CACHE_HOME=FOLDER, a folder to which only you may write",
    )


def library_versions() -> dict[str, str]:
    """Return version texts by name: "python" and each of LIBRARIES; "not installed" for a library that is missing."""
    numbers = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            numbers[name] = version(name)
        except PackageNotFoundError:
            numbers[name] = "not installed"
    return numbers


def libraries(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on LIBRARIES, with their versions: good if all are installed."""
    numbers = library_versions()
    missing = [name for name, number in numbers.items() if number == "not installed"]
    value = ", ".join(f"{name} {number}" for name, number in numbers.items())
    return Finding(
        "libraries",
        value,
        "installed",
        not missing,
        0.0,
        f"{', '.join(missing)}: needed by rtloop, but not installed",
        "in the folder of rtloop's source: pip install .",
    )


CONDITIONS = (compiled_code, libraries)

"""Compilation of the numeric kernels: one set of options, one cache that cannot go stale.

numba decides whether a cached function is still valid by looking at the file that defines it, and only that one: a
loop that calls an edited law would keep running the old law. The cache therefore lives in a folder named by a
digest of every source file that kernels may come from, of the compiler's version and of the processor.

The options keep results equal in bits from one machine to the next: no `fastmath`, no contraction, IEEE division.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import llvmlite
import llvmlite.binding
import numba
import numba.extending
import numba.np.linalg
from numba import config as numba_config

from rtloop.hil.native.uncompiled import address_of
from rtloop.hil.trusted import open_folder


def _load_arrays_without_blas() -> None:
    """Load numba's array functions but not scipy.linalg, which they try to: a quarter of the start of a loop's process.

    No kernel here uses linear algebra. Whose does finds it as ever: scipy is required, and imported where it is used.
    """
    asked = numba.np.linalg.ensure_blas
    numba.np.linalg.ensure_blas = _absent  # pyright: ignore[reportAttributeAccessIssue]
    try:
        from numba.np import arraymath
    finally:
        numba.np.linalg.ensure_blas = asked
    arraymath._HAVE_BLAS = True


def _absent() -> None:
    raise ImportError


_load_arrays_without_blas()
PACKAGE = Path(__file__).parents[2]
KERNELS = ("hil", "drivers", "law", "laws", "engine", "signals.py")
"""Where compiled code, and what it is made from, may stand."""
OPTIONS = "options.py"
"""Files there that hold what a user may say: no kernel is made from one, and an edited text in one compiles nothing."""


def source_digest() -> str:
    """Hexadecimal digest of all sources of kernels, the compiler's version and the processor."""
    digest = hashlib.sha256()
    for place in KERNELS:
        found = PACKAGE / place
        for path in sorted(found.rglob("*.py")) if found.is_dir() else [found]:
            if path.name == OPTIONS:
                continue
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    for fact in (numba.__version__, llvmlite.__version__, platform.python_version(), cpu_identity()):
        digest.update(fact.encode() + b"\0")
    return digest.hexdigest()[:24]


def cpu_identity() -> str:
    """The processor's model and instruction set, as the compiler sees them."""
    return llvmlite.binding.get_host_cpu_name() + " " + llvmlite.binding.get_host_cpu_features().flatten()


def _owned_folder(path: Path) -> bool:
    """Make `path` if needed; True when it is ours alone to write, so that nobody else's code is loaded from it."""
    try:
        os.close(open_folder(path, 0o700))
    except OSError:
        return False
    return os.access(path, os.W_OK | os.X_OK)


def _cache_folder() -> tuple[Path, bool]:
    """The cache's folder, and whether it survives a restart of the machine."""
    digest = source_digest()
    home = os.environ.get("XDG_CACHE_HOME") or (os.environ.get("HOME", "") and f"{os.environ['HOME']}/.cache")
    if home and _owned_folder(Path(home) / "rtloop" / digest):
        return Path(home) / "rtloop" / digest, True
    shared = Path(tempfile.gettempdir()) / f"rtloop-{os.getuid()}"
    if _owned_folder(shared) and _owned_folder(shared / digest):
        return shared / digest, False
    return Path(tempfile.mkdtemp(prefix="rtloop-")), False


CACHE_FOLDER, CACHE_IS_PERSISTENT = _cache_folder()
with contextlib.suppress(OSError):
    os.utime(CACHE_FOLDER)  # in use: the installation of another version drops those unused for longest
numba_config.CACHE_DIR = str(CACHE_FOLDER)  # pyright: ignore[reportAttributeAccessIssue]
# Four equal operations written side by side become one vector operation, which reorders no sum. Loops are left as they
# are: they run over an axis, five states or fifteen plays, and their vector forms cost more than they save.
numba_config.SLP_VECTORIZE, numba_config.LOOP_VECTORIZE = 1, 0  # pyright: ignore[reportAttributeAccessIssue]


UNCOMPILED = bool(getattr(numba_config, "DISABLE_JIT", 0))
"""Whether kernels are to run as they are written, which NUMBA_DISABLE_JIT=1 asks for."""


def jit(function: Callable[..., Any]) -> Any:
    """Compile a kernel on first use, part of its compiled callers; `.py_func` is the same kernel uncompiled.

    Its indices run up to counts that are checked where they are let in: checks of each cost a tenth of the law's time.
    """
    return numba.njit(cache=True, error_model="numpy", forceinline=True)(function)


def guarded(function: Callable[..., Any]) -> Any:
    """As `jit`, for what is told its indices: one beyond its array is an IndexError, and no write to somewhere."""
    return numba.njit(cache=True, error_model="numpy", forceinline=True, boundscheck=True)(function)


def checked(function: Callable[..., Any]) -> Any:
    """Compile somebody else's kernel: an index beyond its array, or a division by zero, is an exception."""
    return numba.njit(error_model="python", boundscheck=True)(function)


def seldom(function: Callable[..., Any]) -> Any:
    """A kernel for what most ticks do not do: called, so that it does not crowd its callers."""
    return numba.njit(cache=True, error_model="numpy")(function)


def seldom_guarded(function: Callable[..., Any]) -> Any:
    """As `seldom`, with checked indices; not for what the law calls, which would be slower for an error to pass on."""
    return numba.njit(cache=True, error_model="numpy", boundscheck=True)(function)


def intrinsic(function: Callable[..., Any]) -> Any:
    """A function that writes its own LLVM code; typed as Any because its callers leave out the typing context."""
    return numba.extending.intrinsic(function)


def inlined(function: Callable[..., Any]) -> Any:
    """A piece of a kernel, put into its callers before anything is compiled, so that they are optimised as one."""
    return numba.njit(inline="always", error_model="numpy")(function)


def cfunc(signature: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a kernel to a C function whose `.address` other compiled code may call."""
    if UNCOMPILED:
        return lambda function: SimpleNamespace(address=address_of(function))
    return numba.cfunc(signature, cache=True, error_model="numpy")


def native_address(kernel: Any, signature: Any) -> int:
    """Address of a kernel, as `jit` or `checked` gives it, for `call_law`; compiled, or loaded, for one signature.

    Raises numba's TypingError and what it raises otherwise for what it cannot compile.
    """
    if UNCOMPILED:
        return address_of(kernel)
    kernel.compile(signature)
    found = kernel.overloads[signature.args]
    return found.library.get_pointer_to_function(found.fndesc.llvm_func_name)

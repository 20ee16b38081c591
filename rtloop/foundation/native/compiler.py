"""numba, configured. Importing this module imports numba, which takes half a second.

The options keep results equal in bits on all machines: no `fastmath`, no contraction, IEEE division.
"""

from __future__ import annotations

from typing import Any

from rtloop.foundation.native.cache import CACHE_FOLDER
from rtloop.foundation.native.default_settings import numba_by_default

with numba_by_default():
    import numba
    import numba.np.linalg
    from llvmlite import ir
    from numba import config
    from numba.core import caching, cgutils, types
    from numba.core.errors import NumbaError
    from numba.core.registry import cpu_target
    from numba.core.sigutils import normalize_signature
    from numba.core.typing.templates import Signature, make_intrinsic_template
    from numba.extending import register_jitable

    from rtloop.foundation.native.numba_cache_file import CheckedCacheFile

__all__ = [
    "NumbaError", "cgutils", "ir", "kernel_type", "make_intrinsic_template", "numba", "parse_signature",
    "register_jitable", "types",
]  # fmt: skip


def _load_arrays_without_blas() -> None:
    """Load numba's array functions without scipy.linalg, a quarter of the time of the import.

    No kernel of rtloop uses linear algebra. For a user's kernel that does, numba imports scipy when it compiles it.
    """
    ensure_blas = numba.np.linalg.ensure_blas
    numba.np.linalg.ensure_blas = _report_no_blas  # pyright: ignore[reportAttributeAccessIssue]
    try:
        from numba.np import arraymath
    finally:
        numba.np.linalg.ensure_blas = ensure_blas
    arraymath._HAVE_BLAS = True


def _report_no_blas() -> None:
    """Raise ImportError, in place of numba's `ensure_blas`, as if scipy were not installed."""
    raise ImportError


_load_arrays_without_blas()
caching.IndexDataCacheFile = CheckedCacheFile  # pyright: ignore[reportAttributeAccessIssue]
config.reload_config = lambda: None  # pyright: ignore[reportAttributeAccessIssue]  # It would read them again.
config.CACHE_DIR = str(CACHE_FOLDER)  # pyright: ignore[reportAttributeAccessIssue]
# Four equal operations written side by side become one vector operation, which reorders no sum. Loops are left as they
# are: they run over an axis, five states or fifteen plays, and their vector forms cost more than they save.
config.SLP_VECTORIZE, config.LOOP_VECTORIZE = 1, 0  # pyright: ignore[reportAttributeAccessIssue]


def kernel_type(value: object) -> types.Type:
    """Return numba's type of a Python value."""
    context: Any = cpu_target.typing_context
    return context.resolve_value_type(value)


def parse_signature(text: str) -> Signature:
    """Return numba's signature for a text such as "int32(int32, intp)". Raises ValueError for one without a result."""
    arguments, result = normalize_signature(text)
    if result is None:
        raise ValueError(f"signature: {text!r} has no result type; allowed: RESULT(ARGUMENTS), such as 'int32(intp)'")
    return result(*arguments)

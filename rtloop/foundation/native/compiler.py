"""The compiler, set up: whoever imports this has numba, which takes half a second.

Its options keep results equal in bits from one machine to the next: no `fastmath`, no contraction, IEEE division.
"""

from __future__ import annotations

from typing import Any

import numba
import numba.np.linalg
from llvmlite import ir
from numba import config
from numba.core import caching, cgutils, types
from numba.core.registry import cpu_target
from numba.core.sigutils import normalize_signature
from numba.core.typing.templates import make_intrinsic_template

from rtloop.foundation.native.cache import CACHE_FOLDER
from rtloop.foundation.native.numba_cache_file import CheckedCacheFile

__all__ = ["cgutils", "ir", "make_intrinsic_template", "numba", "signature_of", "type_of", "types"]


def _load_arrays_without_blas() -> None:
    """Load numba's array functions but not scipy.linalg, which they try to: a quarter of what the import takes.

    No kernel here uses linear algebra. Whose does finds it as ever: scipy is required, and imported where it is used.
    """
    ensure_blas = numba.np.linalg.ensure_blas
    numba.np.linalg.ensure_blas = _report_no_blas  # pyright: ignore[reportAttributeAccessIssue]
    try:
        from numba.np import arraymath
    finally:
        numba.np.linalg.ensure_blas = ensure_blas
    arraymath._HAVE_BLAS = True


def _report_no_blas() -> None:
    raise ImportError


_load_arrays_without_blas()
caching.IndexDataCacheFile = CheckedCacheFile  # pyright: ignore[reportAttributeAccessIssue]
config.CACHE_DIR = str(CACHE_FOLDER)  # pyright: ignore[reportAttributeAccessIssue]
# Four equal operations written side by side become one vector operation, which reorders no sum. Loops are left as they
# are: they run over an axis, five states or fifteen plays, and their vector forms cost more than they save.
config.SLP_VECTORIZE, config.LOOP_VECTORIZE = 1, 0  # pyright: ignore[reportAttributeAccessIssue]


def type_of(value: Any) -> Any:
    """What a kernel takes a value of Python for."""
    context: Any = cpu_target.typing_context
    return context.resolve_value_type(value)


def signature_of(text: str) -> Any:
    """numba's signature, from such as "int32(int32, intp)"."""
    arguments, result = normalize_signature(text)
    assert result is not None
    return result(*arguments)

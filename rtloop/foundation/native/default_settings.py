"""numba's settings: neither the environment nor a file of the current folder decides how kernels are compiled.

numba reads variables NUMBA_… and a file `.numba_config.yaml` when it is imported. Code that was compiled by such
settings would stay in the cache, for later processes without them.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

KEPT = "NUMBA_DISABLE_JIT"
"""The setting that `compiled.UNCOMPILED` follows, too; with it nothing is compiled."""


@contextmanager
def numba_by_default() -> Iterator[None]:
    """Let numba be imported inside the block as if no setting was made. No effect if it was imported before."""
    settings = {name: os.environ.pop(name) for name in [*os.environ] if name.startswith("NUMBA_") and name != KEPT}
    yaml = {"yaml": sys.modules["yaml"]} if "yaml" in sys.modules else {}
    sys.modules["yaml"] = None  # type: ignore[assignment]  # numba then cannot read the file
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numba warns that it cannot read it
            yield
    finally:
        del sys.modules["yaml"]
        sys.modules |= yaml
        os.environ |= settings

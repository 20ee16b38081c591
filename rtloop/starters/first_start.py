"""The first start of a loop on a machine, which compiles its code."""

from __future__ import annotations

FIRST_START = (
    "compiling the loop for this machine, once: half a minute to two minutes, without further output; later starts "
    "take seconds"
)


def is_first_start() -> bool:
    """Whether the cache has no compiled code yet for this version on this processor."""
    from rtloop.foundation.native.cache import CACHE_FOLDER

    return not any(CACHE_FOLDER.iterdir())

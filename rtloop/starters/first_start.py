"""The first start of a loop on a machine, which compiles its code."""

from __future__ import annotations

FIRST_START = (
    "compiling the loop for this machine, once: half a minute to two minutes, without further output; later starts "
    "take seconds"
)
LOOP_CODE = "rtloop.engine.loop.run_ticks.o"
"""File of the loop's compiled code; files of laws may be there before, as `rtloop check` compiles them."""


def is_first_start() -> bool:
    """Whether the cache has no compiled loop yet for this version on this processor."""
    from rtloop.foundation.native.cache import CACHE_FOLDER

    return not (CACHE_FOLDER / LOOP_CODE).exists()

"""Compile everything that runs in real time, so that the first run starts as fast as every other."""

from __future__ import annotations

import shutil
import sys

from hil.compiled import CACHE_FOLDER, CACHE_IS_PERSISTENT

KEPT_CACHES = 4


def main() -> int:
    """Compile the loop for this version and processor, and drop the caches of old versions."""
    from rtloop.engine.rehearsal import rehearse

    rehearse()
    if CACHE_IS_PERSISTENT:
        caches = sorted(CACHE_FOLDER.parent.iterdir(), key=lambda folder: folder.stat().st_mtime, reverse=True)
        for folder in caches[KEPT_CACHES:]:
            if folder != CACHE_FOLDER:
                shutil.rmtree(folder, ignore_errors=True)
    print(f"compiled into {CACHE_FOLDER}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())

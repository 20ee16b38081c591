"""Rigs drawn at random, one after the other."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path


def every_draw(seeds: range, one: Callable[[int, Path], tuple[bool, str]]) -> int:
    """Print what `one` says of each seed, in a folder of its own; 1 where any was bad."""
    bad = 0
    for seed in seeds:
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            good, words = one(seed, Path(folder))
        bad += not good
        print(f"{seed:3} {words}  [{time.perf_counter() - started:.0f} s]{'' if good else '  BAD'}", flush=True)
    print(f"{len(seeds)} rigs, {bad} bad")
    return int(bad > 0)

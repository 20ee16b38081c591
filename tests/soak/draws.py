"""A check of rigs that are drawn at random by seed."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path


def check_draws(seeds: range, check: Callable[[int, Path], tuple[bool, str]]) -> int:
    """Call `check` with each seed and a new folder; it returns whether the rig passed, and a text, which is printed.

    Return 1 if a rig failed, else 0.
    """
    failures = 0
    for seed in seeds:
        start_s = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            passed, text = check(seed, Path(folder))
        failures += not passed
        print(f"{seed:3} {text}  [{time.perf_counter() - start_s:.0f} s]{'' if passed else '  BAD'}", flush=True)
    print(f"{len(seeds)} rigs, {failures} bad")
    return int(failures > 0)

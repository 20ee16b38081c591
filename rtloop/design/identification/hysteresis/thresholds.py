"""Placement of play thresholds, by a rule or by the user."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.hysteresis.play_model import MAX_PLAYS

PlacementRule = Literal["chebyshev", "chebyshev-from-0", "uniform"]
Placement = Literal["auto", "chebyshev", "chebyshev-from-0", "uniform"]


def candidate_placements(placement: Placement) -> tuple[PlacementRule, ...]:
    """Return the rules to try: "chebyshev" and "chebyshev-from-0" for "auto", otherwise `placement` alone.

    Raises ValueError for an unknown placement.
    """
    if placement not in get_args(Placement):
        raise ValueError(f"placement: {placement!r}; allowed: {', '.join(get_args(Placement))}")
    return ("chebyshev", "chebyshev-from-0") if placement == "auto" else (placement,)


def place_thresholds(count: int, largest_v: float, placement: PlacementRule) -> Real:
    """Return n = `count` thresholds in V, rising, below R = `largest_v`, the largest drive. Raises ValueError unless
    1 ≤ count ≤ MAX_PLAYS.

    "chebyshev": R/2·(1 − cos(π i/(n + 1))), i = 1 … n, dense at both ends, where loops are round; n = 15 and R = 10
    give eq (4) within 0.02 V. "chebyshev-from-0": R/2·(1 − cos(π i/n)), i = 0 … n − 1, without a dead band.
    "uniform": R·i/n from 0 on.
    """
    if not 1 <= count <= MAX_PLAYS:
        raise ValueError(f"number of operators: {count}; allowed: 1 to {MAX_PLAYS}")
    if placement == "uniform":
        return largest_v * np.arange(count) / count
    if placement == "chebyshev":
        return 0.5 * largest_v * (1 - np.cos(np.pi * np.arange(1, count + 1) / (count + 1)))
    return 0.5 * largest_v * (1 - np.cos(np.pi * np.arange(count) / count))


def require_ascending(thresholds: Real) -> None:
    """Raise ValueError unless `thresholds` in V are 1 to MAX_PLAYS finite numbers from 0 on, each above the last."""
    if thresholds.ndim != 1 or not 1 <= thresholds.size <= MAX_PLAYS:
        raise ValueError(f"thresholds: {thresholds.size} numbers; allowed: 1 to {MAX_PLAYS}")
    if not np.all(np.isfinite(thresholds)) or thresholds[0] < 0 or np.any(np.diff(thresholds) <= 0):
        raise ValueError(f"thresholds: {thresholds.tolist()} V; allowed: ascending numbers, 0 or more")

"""Identification on many rigs drawn at random: distributions, not the best. `make soak NAME=identification`."""

from __future__ import annotations

import argparse
import sys

import numpy as np

from tests.design.rigs import Closeness, closeness, drawn, identified

LIMITS = {"loop_percent": 1.0, "resonance_percent": 0.5, "damping_percent": 20.0, "gain_percent": 1.0}
CASES = {
    "thresholds of eq (4), placed like them": (0.0, "chebyshev"),
    "thresholds of eq (4), placed uniformly": (0.0, "uniform"),
    "thresholds moved by up to 50 %": (0.5, "chebyshev"),
}


def main() -> None:
    """Every case, and whether its draws keep within what is asked of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    broken = 0
    for name, (moved, placement) in CASES.items():
        found = []
        for seed in range(given.seed, given.seed + given.draws):
            rig = drawn(seed, moved_thresholds=moved)
            found.append(closeness(rig, *identified(rig, placement=placement)))
            if sys.stderr.isatty():
                print(f"\r{name}: {len(found)}/{given.draws} ", end="", file=sys.stderr)
        broken += show(name, found, strict=moved == 0)
    sys.exit(1 if broken else 0)


def show(name: str, found: list[Closeness], *, strict: bool) -> int:
    """The distribution of each quantity; returns how many draws were outside a limit that is asked for."""
    print(f"{name}: {len(found)} draws")
    print(f"  {'':20}{'least':>10}{'5 %':>10}{'median':>10}{'95 %':>10}{'largest':>10}{'outside':>9}")
    broken = 0
    for field in Closeness._fields:
        values = np.array([getattr(one, field) for one in found], dtype=float)
        outside = int(np.sum(np.abs(values) > LIMITS[field])) if field in LIMITS else 0
        if field.startswith("truth"):
            outside = int(np.sum(values > 1 + 1e-9))
        broken += outside if strict or field.startswith("truth") else 0
        points = np.quantile(values, [0, 0.05, 0.5, 0.95, 1])
        print(f"  {field:20}" + "".join(f"{value:10.4f}" for value in points) + f"{outside:9d}", flush=True)
    return broken


if __name__ == "__main__":
    main()

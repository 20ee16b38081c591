"""Two campaigns on the same rigs, paired rig by rig: does one controller pass where the other fails?

Yields are compared by McNemar's exact test (1947): among rigs that pass in one campaign alone, either is equally likely
if the controllers are equally good. Figures are compared by the median of their paired differences, with an interval
by bootstrap over rigs (Efron 1979).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.campaigns.store import PASSED, read_columns, read_manifest
from rtloop.campaigns.summary import CONFIDENCE, Yield, clopper_pearson, independent_rigs
from rtloop.errors import ConfigError
from rtloop.foundation.arrays import Real

RESAMPLES = 2000
"""Samples of the bootstrap, with replacement and as large as the data."""
MOST_NUMBERS = 1_000_000
"""Numbers that the bootstrap holds in memory at a time."""


class FigureDifference(NamedTuple):
    """Median of the second campaign's figure minus the first's, with its interval, over `rigs` with finite figures."""

    rigs: int
    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Comparison:
    """Two campaigns on the same rigs. `only_first` and `only_second` count rigs that pass in one campaign alone.

    `p_value` is the probability of a split at least as uneven between equally good controllers (McNemar's exact test).
    """

    names: tuple[str, str]
    rigs: int
    yields: tuple[Yield, Yield]
    only_first: int
    only_second: int
    p_value: float
    figures: Mapping[str, FigureDifference]


def compare_campaigns(first: Path, second: Path) -> Comparison:
    """Return the comparison of the results in two folders, over the sampled rigs that both have and neither refused.

    Of Saltelli's design, the independent rows alone count. Raises ConfigError for folders whose keys, experiments or
    limits differ, whose rigs differ in a value, or that share no rig; InputFileError for a folder without results or
    with damaged ones, MissingExtra without pyarrow.
    """
    manifests = [read_manifest(folder) for folder in (first, second)]
    columns = [_columns(folder) for folder in (first, second)]
    common, *places = np.intersect1d(columns[0]["rig"], columns[1]["rig"], return_indices=True)
    paired = [
        {name: values[place] for name, values in table.items()} for table, place in zip(columns, places, strict=True)
    ]
    source = f"{first} and {second}"
    if not common.size:
        raise ConfigError(
            source, ["the two campaigns have no rig in common; run both campaigns with the same seed and keys"]
        )
    keys = [key for key in manifests[0]["keys"] if key in manifests[1]["keys"]]
    different = [key for key in keys if not np.array_equal(paired[0][key], paired[1][key])]
    if different or set(manifests[0]["keys"]) != set(manifests[1]["keys"]):
        unequal = different or sorted(set(manifests[0]["keys"]) ^ set(manifests[1]["keys"]))
        raise ConfigError(
            source,
            [
                f"{', '.join(unequal)}: the rigs differ between the campaigns in these keys; run both campaigns with "
                "the same seed, sampling and keys"
            ],
        )
    passed = [table["status"] == PASSED for table in paired]
    only_first, only_second = (int(np.count_nonzero(a & ~b)) for a, b in (passed, passed[::-1]))
    for part in ("experiments", "limits"):
        if manifests[0][part] != manifests[1][part]:
            raise ConfigError(
                source,
                [f"{part}: differ between the two campaigns; allowed: equal {part}; set them in both campaign files"],
            )
    figures = manifests[0]["figures"]
    return Comparison(
        (manifests[0]["campaign"], manifests[1]["campaign"]),
        common.size,
        (_yield(passed[0]), _yield(passed[1])),
        only_first,
        only_second,
        mcnemar(only_first, only_second),
        {name: paired_difference(paired[0][name], paired[1][name]) for name in figures},
    )


def mcnemar(only_first: int, only_second: int) -> float:
    """Return the two-sided p-value of McNemar's exact test for two counts of rigs that pass in one campaign alone.

    The p-value is 1 if both counts are 0.
    """
    from scipy.stats import binomtest

    total = only_first + only_second
    return float(binomtest(only_first, total).pvalue) if total else 1.0


def paired_difference(first: Real, second: Real, seed: int = 0) -> FigureDifference:
    """Return the median of `second` − `first` (n,) over the pairs that are finite, with its bootstrap interval (95 %).

    The bootstrap draws with `seed`. The interval is NaN for less than two pairs, the median is NaN for none.
    """
    from scipy.stats import bootstrap

    finite = np.isfinite(first) & np.isfinite(second)
    differences = second[finite] - first[finite]
    if differences.size < 2:
        median = float(np.median(differences)) if differences.size else float("nan")
        return FigureDifference(int(differences.size), median, float("nan"), float("nan"))
    interval = bootstrap(
        (differences,), np.median, n_resamples=RESAMPLES, batch=max(MOST_NUMBERS // differences.size, 1),
        confidence_level=CONFIDENCE, method="percentile", rng=np.random.Generator(np.random.PCG64(seed)),
    ).confidence_interval  # fmt: skip
    median = float(np.median(differences))
    return FigureDifference(int(differences.size), median, float(interval.low), float(interval.high))


def _columns(folder: Path) -> dict[str, np.ndarray]:
    """Return the columns of all sampled rigs in a folder that could run and are independent, by name.

    Raises as `read_columns`.
    """
    columns = read_columns(folder)
    counted = independent_rigs(columns, read_manifest(folder))
    return {name: values[counted] for name, values in columns.items()}


def _yield(passed: npt.NDArray[np.bool_]) -> Yield:
    """Return the yield of rigs, with its interval (95 %); `passed` (n,) are truth values."""
    return clopper_pearson(int(np.count_nonzero(passed)), len(passed))

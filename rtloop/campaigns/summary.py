"""Summary of a campaign from its stored results: yield with its interval, distributions of figures, the worst rigs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.campaigns.case import NOMINAL
from rtloop.campaigns.samples import block_size
from rtloop.campaigns.sensitivity import SensitivityIndex, sensitivity_indices
from rtloop.campaigns.store import CRASHED, FAILED, PASSED, REFUSED, Manifest, read_columns, read_manifest

CONFIDENCE = 0.95
INDEPENDENT_ROWS = 2
"""Rows of a block of Saltelli's design that are drawn independently: the first two."""
SHOWN_SHARES = (0.05, 0.5, 0.95)
"""Shares of rigs whose figures are shown as quantiles."""


class Yield(NamedTuple):
    """Share of rigs that pass, and the interval of Clopper and Pearson (1934) for the share of all such rigs.

    The interval covers the share with at least CONFIDENCE where rigs are drawn independently, by sampling = "random";
    with "latin_hypercube" and "sobol" the estimate is closer than the interval says.
    """

    passed: int
    rigs: int
    share: float
    low: float
    high: float


class FigureSummary(NamedTuple):
    """Quantiles of a figure at SHOWN_SHARES, its largest value, its limit (None without one), and rigs beyond it."""

    quantiles: tuple[float, ...]
    largest: float
    limit: float | None
    exceeding: int


class WorstRig(NamedTuple):
    """A rig with a large `ratio`, its largest figure in parts of its limit; missed limits; values by key."""

    rig: int
    ratio: float
    missed: str
    values: Mapping[str, object]


@dataclass(frozen=True)
class CampaignSummary:
    """Result of a campaign. Counts, yield and figures leave out the nominal rig.

    `counts` has the number of rigs by status, `crashed` the number of each rig that crashed, `refused` (number, reason)
    of each refused rig, the nominal rig 0 included, `nominal` the nominal rig's row by column, {} without a result.
    """

    name: str
    counts: Mapping[str, int]
    yield_of_rigs: Yield
    figures: Mapping[str, FigureSummary]
    causes: Mapping[str, int]
    """Number of rigs for each limit that was missed and each trip."""
    worst_rigs: tuple[WorstRig, ...]
    crashed: tuple[int, ...]
    refused: tuple[tuple[int, str], ...]
    nominal: Mapping[str, Any]
    sensitivity: Mapping[str, Mapping[str, SensitivityIndex]]
    """Sobol's indices of each figure and of passing, by key; empty unless sampling is "saltelli"."""


def clopper_pearson(passed: int, rigs: int, confidence: float = CONFIDENCE) -> Yield:
    """Return the yield of `passed` among `rigs`, with its interval; for 0 rigs the share NaN and the interval 0 … 1.

    Raises ValueError for more passed than rigs, and for a negative number.
    """
    from scipy.special import betaincinv

    if not 0 <= passed <= rigs:
        raise ValueError(f"passed: {passed}; allowed: 0 … {rigs}")
    if not rigs:
        return Yield(0, 0, float("nan"), 0.0, 1.0)
    outside, failed = (1 - confidence) / 2, rigs - passed
    low = float(betaincinv(passed, failed + 1, outside)) if passed else 0.0
    high = float(betaincinv(passed + 1, failed, 1 - outside)) if failed else 1.0
    return Yield(passed, rigs, passed / rigs, low, high)


def summarise_campaign(folder: Path, worst_count: int = 5) -> CampaignSummary:
    """Return the summary of the results in a folder, with the `worst_count` rigs of the largest ratio.

    Refused rigs count neither as passed nor as failed; crashed ones count as failed in the yield. Raises InputFileError
    for a folder without results or with damaged ones, MissingExtra without pyarrow.
    """
    manifest = read_manifest(folder)
    columns = read_columns(folder)
    sampled = columns["rig"] != NOMINAL
    states = columns["status"][sampled]
    counts = {state: int(np.count_nonzero(states == state)) for state in (PASSED, FAILED, REFUSED, CRASHED)}
    columns_judged = {name: values[sampled & (columns["status"] != REFUSED)] for name, values in columns.items()}
    return CampaignSummary(
        manifest["campaign"],
        counts,
        _yield(columns, manifest),
        _figures(columns_judged, manifest["figures"], manifest["limits"]),
        Counter(
            cause for missed in columns_judged["missed"] for cause in missed.split("; ") if cause and cause != CRASHED
        ),
        _worst_rigs(columns_judged, manifest["keys"], worst_count),
        tuple(columns["rig"][columns["status"] == CRASHED].tolist()),
        tuple(
            (int(rig), str(text))
            for rig, state, text in zip(columns["rig"], columns["status"], columns["missed"], strict=True)
            if state == REFUSED
        ),
        {name: value for name, values in columns.items() for value in values[~sampled].tolist()},
        _sensitivity(columns, manifest),
    )


def independent_rigs(columns: Mapping[str, np.ndarray], manifest: Manifest) -> npt.NDArray[np.bool_]:
    """Return for each row, (rigs,), whether it counts for a yield: sampled, not refused, and drawn independently."""
    counted = (columns["rig"] != NOMINAL) & (columns["status"] != REFUSED)
    if manifest["sampling"] == "saltelli":
        counted &= (columns["rig"] - 1) % block_size(len(manifest["keys"])) < INDEPENDENT_ROWS
    return counted


def _yield(columns: Mapping[str, np.ndarray], manifest: Manifest) -> Yield:
    """Return the yield of the sampled rigs that could run; of Saltelli's design the independent rows alone count."""
    states = columns["status"][independent_rigs(columns, manifest)]
    return clopper_pearson(int(np.count_nonzero(states == PASSED)), states.size)


def _sensitivity(columns: Mapping[str, np.ndarray], manifest: Manifest) -> dict[str, Mapping[str, SensitivityIndex]]:
    """Return Sobol's indices of "passed" and of each figure, by this quantity and then by uncertain key.

    {} unless the sampled rigs follow Saltelli's design without a gap.
    """
    order = np.argsort(columns["rig"])
    rigs = columns["rig"][order][columns["rig"][order] != NOMINAL]
    if manifest["sampling"] != "saltelli" or not np.array_equal(rigs, np.arange(1, len(rigs) + 1)):
        return {}
    sampled = order[len(order) - len(rigs) :]
    passed = np.where(columns["status"] == REFUSED, np.nan, columns["status"] == PASSED)
    quantities = {"passed": passed.astype(float)}
    quantities |= {name: columns[name] for name in manifest["figures"]}
    return {name: sensitivity_indices(values[sampled], manifest["keys"]) for name, values in quantities.items()}


def _figures(
    columns: Mapping[str, np.ndarray], names: Sequence[str], limits: Mapping[str, float]
) -> dict[str, FigureSummary]:
    """Return the summary of each figure by name, over all rigs that have it; a figure that no rig has is left out."""
    summaries = {}
    for name in names:
        values = columns[name][~np.isnan(columns[name])]
        limit = limits.get(name)
        if values.size:
            quantiles = np.quantile(values, SHOWN_SHARES, method="higher").tolist()
            exceeding = 0 if limit is None else int(np.count_nonzero(values > limit))
            summaries[name] = FigureSummary(tuple(quantiles), float(np.max(values)), limit, exceeding)
    return summaries


def _worst_rigs(columns: Mapping[str, np.ndarray], keys: Sequence[str], count: int) -> tuple[WorstRig, ...]:
    """Return the `count` rigs of the largest ratio that did not crash, the largest first; there may be fewer.

    Where ratios are equal, the lower number is first.
    """
    order = [i for i in np.lexsort((columns["rig"], -columns["ratio"])) if columns["status"][i] != CRASHED]
    return tuple(
        WorstRig(
            int(columns["rig"][i]),
            float(columns["ratio"][i]),
            str(columns["missed"][i]),
            {key: columns[key][i] for key in keys},
        )
        for i in order[:count]
    )

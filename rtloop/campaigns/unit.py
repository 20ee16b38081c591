"""Units of work: some rigs of a campaign, run one after the other in a worker's process.

A unit's rigs depend on the campaign alone, not on workers and not on time: so do the files of its results.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from typing import NamedTuple

from rtloop.campaigns.campaign_file import Campaign
from rtloop.campaigns.case import NOMINAL, CaseResult, CaseRunner
from rtloop.errors import RtloopError
from rtloop.version import __version__

UNIT_S, TICK_S, EXPERIMENT_S, MAX_RIGS = 1.0, 2e-7, 1.3e-3, 1000
"""Duration that a unit should have; assumed durations of a tick and of an experiment without ticks; most rigs."""
RUNNERS_KEPT = 4
NUMERICAL_PACKAGES = ("numpy", "scipy", "numba")
"""Packages whose versions may change the last bits of a result."""


class OtherVersion(RtloopError):
    """A worker has another version of rtloop, or of a numerical package, than the coordinator."""

    exit_code = 69


class Unit(NamedTuple):
    """Rigs `first` … `last` of a campaign, the last one included."""

    first: int
    last: int

    @property
    def rigs(self) -> range:
        """Numbers of the rigs, in their order."""
        return range(self.first, self.last + 1)


@dataclass(frozen=True)
class WorkerFacts:
    """Versions of packages of a worker, (name, version) each, which may change the last bits of its results."""

    versions: tuple[tuple[str, str], ...]

    @classmethod
    def of_this_process(cls) -> WorkerFacts:
        """Return the versions of rtloop and NUMERICAL_PACKAGES in this process."""
        return cls((("rtloop", __version__), *((name, version(name)) for name in NUMERICAL_PACKAGES)))


def split_into_units(campaign: Campaign, rate_hz: float) -> list[Unit]:
    """Return the units of a campaign: the nominal rig alone, then `unit_rigs` rigs each.

    Without that option, they have as many rigs as take about UNIT_S, 1 to MAX_RIGS. Their size depends on the
    campaign's file and on `rate_hz` alone: further rigs leave full units as they are.
    """
    experiments = campaign.options.experiment
    ticks = sum(experiment.ticks(rate_hz) for experiment in experiments)
    size = min(max(math.floor(UNIT_S / (ticks * TICK_S + len(experiments) * EXPERIMENT_S)), 1), MAX_RIGS)
    size, rigs = campaign.options.unit_rigs or size, campaign.options.rigs
    return [
        Unit(NOMINAL, NOMINAL),
        *(Unit(first, min(first + size - 1, rigs)) for first in range(NOMINAL + 1, rigs + 1, size)),
    ]


def run_unit(campaign: Campaign, rigs: Sequence[int], expected: WorkerFacts) -> list[CaseResult]:
    """Run rigs of a campaign, by number, in this process; return their results in the same order.

    Raises OtherVersion if this process has other versions than `expected`, ConfigError for a campaign that cannot run
    here.
    """
    _require_versions(expected)
    runner = _runner(_Hashed(campaign.digest, campaign))
    return [runner.run(rig) for rig in rigs]


def run_values(
    campaign: Campaign, rigs: Sequence[tuple[int, Mapping[str, object]]], expected: WorkerFacts
) -> list[CaseResult]:
    """Run rigs, (number, values by key) each, and return their results in the same order; raises as `run_unit`."""
    _require_versions(expected)
    runner = _runner(_Hashed(campaign.digest, campaign))
    return [runner.run(number, values) for number, values in rigs]


def _require_versions(expected: WorkerFacts) -> None:
    """Raise OtherVersion if the versions of this process are not the expected ones, of the same packages."""
    facts = WorkerFacts.of_this_process()
    differences = [
        f"{name} {version_here}, the coordinator {expected_version}"
        for (name, version_here), (_, expected_version) in zip(facts.versions, expected.versions, strict=True)
        if version_here != expected_version
    ]
    if differences:
        raise OtherVersion(f"this worker has {'; '.join(differences)}; install equal versions on all workers")


class _Hashed:
    """A campaign that is hashed and compared by its digest and its number of rigs."""

    def __init__(self, digest: str, campaign: Campaign) -> None:
        """Store the campaign and its key: `digest` and its number of rigs."""
        self.key, self.campaign = (digest, campaign.options.rigs), campaign

    def __hash__(self) -> int:
        """Return the hash of digest and number of rigs."""
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        """Whether `other` has a campaign with the same digest and the same number of rigs."""
        return isinstance(other, _Hashed) and self.key == other.key


@lru_cache(RUNNERS_KEPT)
def _runner(hashed: _Hashed) -> CaseRunner:
    """Return the runner of a campaign; the RUNNERS_KEPT runners of this process that were used last are cached.

    Raises ConfigError for a campaign that cannot run here.
    """
    return CaseRunner(hashed.campaign)

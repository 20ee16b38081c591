"""A case: one rig of a campaign, run in this process. It has values, figures and a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from rtloop.campaigns.campaign_file import Campaign
from rtloop.campaigns.keys import FIXED_KEYS, option_value
from rtloop.campaigns.rig_builder import Loop, RigBuilder, experiment_plan
from rtloop.campaigns.rig_experiments import POINTS, Experiment, Motion
from rtloop.campaigns.samples import noise_seed, unit_samples
from rtloop.configuration.file import describe
from rtloop.configuration.rig import true_positions
from rtloop.drivers.sim import SimDriver
from rtloop.engine.in_process import LoopsInProcess
from rtloop.engine.plan import Plan
from rtloop.errors import ConfigError
from rtloop.foundation.arrays import Real
from rtloop.signals import trip_causes

SEED_KEY = "driver.seed"
"""Key of the noise's seed, of which every rig has its own unless the campaign names it."""
NOMINAL = 0
"""Number of the nominal rig, whose keys have the configured values."""
LOOP_ENDED = "the loop ended early"
"""Cause of a failure where the driver, the clock or the record of a law failed in a tick."""
SHARES_FOR_EFFECT = (0.25, 0.75)
"""Shares of a distribution at which two rigs must have different records, coefficients or plans."""


@dataclass(frozen=True)
class CaseResult:
    """Values, figures and verdict of one rig.

    `values` by key are read back from the rig that ran; `figures` are by "EXPERIMENT.FIGURE". `trips` has the causes of
    a trip for each experiment by its name, "" without one; `missed` names every limit that is exceeded and every trip;
    `ratio` is the largest figure in parts of its limit, infinite after a trip, 0 without limits. `refusal` says why a
    rig cannot run, "" if it ran; a rig that cannot run has no figures and the ratio NaN, and its `values` are those
    drawn.
    """

    rig: int
    values: Mapping[str, object]
    figures: Mapping[str, float]
    trips: Mapping[str, str]
    missed: tuple[str, ...]
    ratio: float
    refusal: str = ""

    @property
    def has_passed(self) -> bool:
        """Whether the rig ran, no experiment tripped and every figure is within its limit."""
        return not self.missed and not self.refusal


class CaseRunner:
    """Runs rigs of one campaign in this process.

    Raises ConfigError for a configuration that cannot run, for an uncertain key that does not exist, that the campaign
    or an experiment sets or that has no effect, and for an experiment that the loop's rate does not allow.
    """

    def __init__(self, campaign: Campaign) -> None:
        """Build the nominal loop, and check all uncertain keys and experiments. Raises ConfigError with all faults."""
        self.campaign, self.options = campaign, campaign.options
        self._builder, self._loops = RigBuilder(campaign), LoopsInProcess()
        self.keys = tuple(self.options.uncertain)
        faults = [f"uncertain.{fault}" for key in self.keys if (fault := self._key_fault(key))]
        faults += [fault for experiment in self.options.experiment if (fault := self._experiment_fault(experiment))]
        if faults:
            raise ConfigError(campaign.name, faults)

    @property
    def rate_hz(self) -> float:
        """Rate of the nominal loop in Hz."""
        return self._builder.rate_hz

    def sample_values(self, rig: int) -> dict[str, Any]:
        """Return the values of a rig's uncertain keys, by key, and under "driver.seed" the seed of its noise.

        The rig NOMINAL, 0, has the configured values. Raises ValueError for a rig beyond the campaign's number of
        rigs, and as `quantile_value`.
        """
        options = self.options
        if rig == NOMINAL:
            return {key: self._builder.nominal_value(key) for key in dict.fromkeys((SEED_KEY, *self.keys))}
        shares = unit_samples(options.sampling, self.keys, rig - 1, 1, options.rigs, options.seed)[0]
        return self.quantile_values(rig, shares)

    def quantile_values(self, rig: int, shares: Real) -> dict[str, object]:
        """Return the values of rig number `rig`, by key, at `shares` (keys,), in (0, 1), of the keys' distributions.

        Under "driver.seed" is the seed of its noise, unless this key is uncertain itself. Raises as `quantile_value`.
        """
        values = {key: self.quantile_value(key, float(share)) for key, share in zip(self.keys, shares, strict=True)}
        return {SEED_KEY: noise_seed(self.options.seed, rig), **values}

    def quantile_value(self, key: str, share: float) -> Any:
        """Return the value of a key at a `share`, in (0, 1), of its distribution.

        Raises ValueError for a relative distribution of a key that has no number, and for a normal distribution that
        has practically no values between its limits.
        """
        distribution = self.options.uncertain[key]
        value = distribution.quantile(share)
        if not distribution.relative:
            return value
        nominal = self._builder.nominal_value(key)
        if isinstance(nominal, bool) or not isinstance(nominal, int | float):
            raise ValueError(
                f"{key}: the configuration has the value {nominal!r}; allowed with relative = true: a number"
            )
        return nominal * value

    def run(self, rig: int, values: Mapping[str, object] | None = None) -> CaseResult:
        """Run all experiments of a rig; return its figures and verdict, with a `refusal` for a rig that cannot run.

        `values` by key replace all drawn ones; of a key that they lack, also of "driver.seed", the configured value
        counts. Raises RuntimeError if the rig that runs has another value than the one given or drawn, and without
        `values` ValueError for a rig whose values cannot be drawn, see `sample_values`.
        """
        drawn = self.sample_values(rig) if values is None else dict(values)
        try:
            loop = self._builder.loop(drawn)
            outcomes = [self._run_experiment(loop, drawn, experiment) for experiment in self.options.experiment]
        except (ConfigError, ValueError) as error:
            return CaseResult(rig, drawn, {}, {}, (), math.nan, _refusal_text(error))
        figures = dict(zip(self.options.figures, (x for outcome in outcomes for x in outcome.figures), strict=True))
        labels = (experiment.label for experiment in self.options.experiment)
        trips = dict(zip(labels, (outcome.trip for outcome in outcomes), strict=True))
        return CaseResult(rig, outcomes[-1].values, figures, trips, *_judge(figures, trips, self.campaign.limits))

    def configuration_text(self, values: Mapping[str, object], experiment: Experiment, heading: str) -> str:
        """Return the configuration of a rig with `values` in one experiment as TOML, for a run that is recorded.

        Its first line is `heading` as a comment, after "# ". Raises ValueError for values that the configuration has no
        place for.
        """
        return self._builder.text(values, experiment, heading)

    def _run_experiment(self, loop: Loop, drawn: Mapping[str, object], experiment: Experiment) -> _Outcome:
        """Run one experiment on a rig; return its outcome, with infinite figures if the loop ended early.

        Raises ValueError for an impossible rig, and where ticks were so late that the motion between them is unknown;
        RuntimeError if the rig that runs has another value than the one `drawn`.
        """
        driver = self._builder.driver(loop, drawn, experiment)
        values = {key: option_value(loop.configuration, driver.options, key) for key in drawn}
        for key, value in drawn.items():
            if values[key] != value:
                raise RuntimeError(
                    f"{key}: the campaign set {value!r}, but the rig that runs has {values[key]!r}; this is a fault of "
                    "rtloop, report it with the campaign's files"
                )
        axis = self._builder.axis
        seed = int(option_value(loop.configuration, driver.options, SEED_KEY))
        plan, ticks = experiment_plan(loop.plan, axis, experiment, seed)
        coefficients, state = driver.rig
        rig_at_rest = coefficients, state.copy()
        columns = self._run_loop(plan, driver, ticks)
        if len(columns["flags"]) < ticks:
            return _Outcome((math.inf,) * len(experiment.figures), LOOP_ENDED, values)
        position_um = true_positions(driver, rig_at_rest, axis, columns, POINTS)
        if np.any(columns["periods_missed"]):
            _require_equal(position_um[:, 0], columns[f"{axis}_true_position_um"])
        motion = Motion(columns[f"{axis}_reference_um"], position_um, plan.pacing.rate_hz)
        flags = int(np.bitwise_or.reduce(columns["flags"].astype(np.int64)))
        return _Outcome(experiment.measure(motion), ", ".join(trip_causes(flags)), values)

    def _run_loop(self, plan: Plan, driver: SimDriver, ticks: int) -> dict[str, Real]:
        """Run a plan for `ticks`; return by name the recorded columns that figures and verdict need.

        Each column is (n,): n is `ticks`, or less if the driver, the clock or the record of a law fails, which ends
        the loop early. A law that raises an error trips; the loop then runs on.
        """
        names = (
            "flags",
            "periods_missed",
            f"{self._builder.axis}_reference_um",
            f"{self._builder.axis}_true_position_um",
            *(f"{axis}_hysteresis_um" for axis in plan.axes),
        )
        indices = [plan.columns.index(name) for name in names]
        columns = np.empty((len(names), ticks))

        def store(first: int, rows: Real) -> None:
            """Copy the needed columns of `rows`, (n, all columns): the ticks from `first` on."""
            columns[:, first : first + len(rows)] = rows[:, indices].T

        done = self._loops.run(plan, driver, ticks, store)
        return dict(zip(names, columns[:, :done], strict=True))

    def _key_fault(self, key: str) -> str:
        """Return the fault of an uncertain key that is unknown, fixed, set by an experiment, or without effect.

        A value at which the rig cannot run is a fault, too; tried are the configured value, the quartiles and each
        entry of a choice. Returns "" for a key without a fault.
        """
        if key.startswith(FIXED_KEYS):
            return (
                f"{key}: this key cannot be uncertain, as the campaign sets it or other keys depend on it; remove it "
                "from [uncertain]"
            )
        disturbing = [experiment.label for experiment in self.options.experiment if experiment.disturbance is not None]
        if disturbing and "disturbance" in key.split("."):
            return f"{key}: experiment {disturbing[0]!r} sets the disturbance; remove the key or the experiment"
        try:
            entries = self.options.uncertain[key].choice or ()
            shares = [*SHARES_FOR_EFFECT, *((number + 0.5) / len(entries) for number in range(len(entries)))]
            values = [self._builder.nominal_value(key), *(self.quantile_value(key, share) for share in shares)]
            rigs = {self._builder.fingerprint({key: value}) for value in values}
        except (ConfigError, ValueError) as error:
            text = _refusal_text(error)
            return text if text.startswith(key) else f"{key}: {text}"
        if len(rigs) > 1:
            return ""
        return f"{key}: has no effect, as rigs with {values[1]!r} and {values[2]!r} run alike; remove the key"

    def _experiment_fault(self, experiment: Experiment) -> str:
        """Return the fault of an experiment that the loop's rate does not allow, or that is too short for a figure.

        Returns "" for an experiment without a fault.
        """
        try:
            loop = self._builder.loop({})
            plan, ticks = experiment_plan(loop.plan, self._builder.axis, experiment, 0)
            rate_hz = plan.pacing.rate_hz
            experiment.measure(Motion(np.zeros(ticks), np.zeros((ticks, POINTS)), rate_hz))
        except (ConfigError, ValueError) as error:
            return f"experiment.{experiment.label}: {_refusal_text(error)}; the loop runs at {self.rate_hz:g} Hz"
        if beyond := self._builder.beyond_reach(experiment):
            remedy = "Use other levels, another offset_um or hold_um, or a smaller amplitude_um"
            return f"experiment.{experiment.label}: {beyond}. {remedy}"
        return ""


class _Outcome(NamedTuple):
    """Figures of one experiment, causes of its trip ("" without one), and the values of the rig that ran, by key."""

    figures: tuple[float, ...]
    trip: str
    values: dict[str, object]


def _require_equal(computed_um: Real, recorded_um: Real) -> None:
    """Raise ValueError unless the positions at ticks, computed from the record, are exactly the recorded ones.

    The positions differ where the actuator moved in periods without a tick: by a drive that latency delayed, by creep
    or by a fault.
    """
    if not np.array_equal(computed_um, recorded_um, equal_nan=True):
        raise ValueError(
            "the actuator moved in periods that the loop missed, so its true position in these periods is unknown; "
            "remove lateness from the campaign, or set lateness to a recording whose ticks are all less than one "
            "period late. Missed periods are allowed only for a rig with driver.latency_ticks = 0, without creep and "
            "without the fault drive_lost"
        )


def _judge(
    figures: Mapping[str, float], trips: Mapping[str, str], limits: Mapping[str, float]
) -> tuple[tuple[str, ...], float]:
    """Return the names of exceeded limits, then a text for each trip, and the largest ratio of a figure to its limit.

    The ratio is infinite after a trip, and 0 without limits. In place of the ratio to a limit of 0 or less, 1 + the
    figure counts if the figure is above the limit, else 0.
    """
    missed = [name for name, limit in limits.items() if not figures[name] <= limit]
    missed += [f"{label} tripped: {trip}" for label, trip in trips.items() if trip]
    ratios = [
        figures[name] / limit if limit > 0 else 1.0 + figures[name] if figures[name] > limit else 0.0
        for name, limit in limits.items()
    ]
    return tuple(missed), math.inf if any(trips.values()) else max(ratios, default=0.0)


def _refusal_text(error: Exception) -> str:
    """Return the faults of an error on one line, separated by "; ", without the file's name."""
    if isinstance(error, ConfigError):
        return "; ".join(error.faults)
    if isinstance(error, ValidationError):
        return "; ".join(describe(error, "driver", None))
    return str(error)

"""Building of a rig from the values of uncertain keys: configuration and plan of the loop, and the driver.

Where the uncertain keys are the driver's alone, configuration and plan are built once.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

from rtloop.campaigns.campaign_file import Campaign
from rtloop.campaigns.keys import is_rig_key, option_value, replace_values
from rtloop.campaigns.rig_experiments import Experiment
from rtloop.configuration.cautions import reference_cautions
from rtloop.configuration.file import Configuration, parse
from rtloop.configuration.laws import Library
from rtloop.configuration.prepare import prepare
from rtloop.configuration.reference_options import ReferenceOptions, StepsOptions
from rtloop.configuration.references import TableOfSamples, generator_values
from rtloop.configuration.text_files import parse_toml
from rtloop.design.toml_text import write_section
from rtloop.drivers.registry import driver_class
from rtloop.drivers.sim import SimDriver
from rtloop.engine.plan import Plan
from rtloop.errors import ConfigError
from rtloop.signals import Mode

ROTATION = ("rotate_mib", "rotate_s", "around", "keep_gib")
"""Keys of [recording] that a campaign leaves out: a rig's recording is one whole file."""
HARDWARE_SWITCHES = ("enable_input", "hold_input", "hold_min_v", "hold_while")
"""Keys of [loop] that a campaign leaves out."""


class Loop(NamedTuple):
    """A configuration and its plan, for all rigs that differ in the driver's options alone."""

    configuration: Configuration
    plan: Plan


class RigBuilder:
    """Builds loop and rig of a campaign for any values of its uncertain keys.

    Raises ConfigError for a configuration that cannot run, and for one that is not on the simulated rig.
    """

    def __init__(self, campaign: Campaign) -> None:
        """Build the nominal loop of a campaign. Raises ConfigError unless it can run on the simulated rig."""
        self._campaign = campaign
        self._tables = _tables_at_rest(campaign)
        self._nominal = self._build_loop(self._tables)
        self.axis = campaign.options.axis or self._nominal.plan.axes[0]
        self._varies_rig_only = all(map(is_rig_key, campaign.options.uncertain))

    @property
    def rate_hz(self) -> float:
        """Rate of the nominal loop, in Hz."""
        return self._nominal.plan.pacing.rate_hz

    def nominal_value(self, key: str) -> Any:
        """Return the value of a key in the configuration, defaults included.

        Raises ValueError for a key that no option has.
        """
        return option_value(self._nominal.configuration, self._nominal.configuration.driver_options, key)

    def loop(self, values: Mapping[str, object]) -> Loop:
        """Return the loop of a rig with `values` by key; the nominal one if all uncertain keys are the driver's.

        Values that are None are left out. Raises ConfigError, ValueError for values that cannot run.
        """
        return (
            self._nominal if self._varies_rig_only else self._build_loop(replace_values(self._tables, _present(values)))
        )

    def driver(self, loop: Loop, values: Mapping[str, object], experiment: Experiment) -> SimDriver:
        """Return the driver, not opened, of a rig with `values` and with the disturbance of one experiment.

        Only the keys of the driver in `values` count. Raises ValueError for options that the driver does not allow.
        """
        changed = replace_values({"driver": self._tables["driver"]}, _rig_values(values))
        tables = self._add_disturbance(changed, experiment)
        options = {key: value for key, value in tables["driver"].items() if key not in ("kind", "channels")}
        kind = driver_class(SimDriver.kind)
        model = kind.options_model.model_validate(options)
        return cast("SimDriver", kind(model, loop.plan.wiring, loop.plan.pacing.rate_hz))

    def text(self, values: Mapping[str, object], experiment: Experiment, heading: str) -> str:
        """Return the configuration of a rig in one experiment as TOML, whose first line is the comment `heading`.

        `values` are by key; a value None is left out. Raises ValueError for a key for which the tables have no place.
        """
        tables = self._add_disturbance(replace_values(self._tables, _present(values)), experiment)
        return write_section("", self._play(tables, experiment.reference), [heading])

    def beyond_reach(self, experiment: Experiment) -> str:
        """Return in words what the reference of an experiment exceeds on the nominal rig; "" if it is within reach.

        The level 0 before the first step does not count: an actuator that a drive of one sign moves is there only once.
        """
        reference = experiment.reference
        if isinstance(reference, StepsOptions):
            reference = reference.model_copy(update={"levels": reference.levels[1:]})
        loop = self._build_loop(self._play(self._tables, reference))
        axis = next(axis for axis in loop.configuration.axes if axis.name == self.axis)
        return "; ".join(reference_cautions(loop.configuration, loop.plan, axis))

    def fingerprint(self, values: Mapping[str, object]) -> bytes:
        """Return bytes that are equal for two sets of values with equal plans and, in every experiment, equal rigs.

        A rig here is the coefficients and the state of the simulated rig at its start.
        Raises as `loop` and `driver`.
        """
        loop = self.loop(values)
        parts = [pickle.dumps(replace(loop.plan, driver_options={}, name=""))]
        for experiment in self._campaign.options.experiment:
            parts += [records.tobytes() for records in self.driver(loop, values, experiment).rig]
        return b"".join(parts)

    def _build_loop(self, tables: Mapping[str, object]) -> Loop:
        """Return configuration and plan of a configuration's tables, for virtual time and with mode closed_loop.

        Raises ConfigError where they cannot run on a simulated rig.
        """
        campaign, name = self._campaign, self._campaign.configuration_name
        library = Library(campaign.folder, campaign.laws) if campaign.laws is not None else None
        configuration = parse(write_section("", tables, []), name, campaign.folder, name, library)
        if configuration.driver_kind != SimDriver.kind:
            fault = f"driver.kind: {configuration.driver_kind!r}; a campaign needs the simulated rig, kind = 'sim'"
            raise ConfigError(name, [fault])
        return Loop(configuration, replace(prepare(configuration, paced=False).plan, mode=Mode.CLOSED_LOOP))

    def _play(self, tables: dict[str, Any], reference: ReferenceOptions) -> dict[str, Any]:
        """Return tables whose axis plays a reference; `tables` stay as they are."""
        played = reference.model_dump(mode="json", exclude_unset=True)
        axes = [{**axis, "reference": played} if axis["name"] == self.axis else axis for axis in tables["axis"]]
        return {**tables, "axis": axes}

    def _add_disturbance(self, tables: dict[str, Any], experiment: Experiment) -> dict[str, Any]:
        """Return tables whose driver has the disturbance of an experiment on the axis that it moves.

        `tables` stay as they are, and are returned themselves for an experiment without a disturbance.
        """
        if experiment.disturbance is None:
            return tables
        driver = dict(tables["driver"])
        plants = driver.get("plants", {})
        plant = {**copy.deepcopy(plants.get(self.axis, driver.get("plant", {}))), "disturbance": experiment.disturbance}
        if len(self._nominal.plan.axes) == 1 and self.axis not in plants:
            driver["plant"] = plant
        else:
            driver["plants"] = {**plants, self.axis: plant}
        return {**tables, "driver": driver}


def _present(values: Mapping[str, object]) -> dict[str, object]:
    """Return the values that are not None: a configuration has no key for a value None."""
    return {key: value for key, value in values.items() if value is not None}


def _rig_values(values: Mapping[str, object]) -> dict[str, object]:
    """Return the entries whose dotted keys belong to the rig (`is_rig_key`), with unchanged keys."""
    return {key: value for key, value in values.items() if is_rig_key(key)}


def _tables_at_rest(campaign: Campaign) -> dict[str, Any]:
    """Return the tables of a campaign's configuration, in closed loop, with all axes at rest at 0, without a schedule.

    The keys HARDWARE_SWITCHES of [loop] and ROTATION of [recording] are left out. The campaign's lateness of ticks, if
    any, is in [loop].
    """
    tables = parse_toml(campaign.configuration_text)
    tables["loop"] = {key: value for key, value in tables["loop"].items() if key not in HARDWARE_SWITCHES}
    tables["loop"]["mode"] = "closed_loop"
    if campaign.lateness_us:
        tables["loop"]["simulated_lateness_us"] = list(campaign.lateness_us)
    tables.pop("schedule", None)
    tables["recording"] = {key: value for key, value in tables.get("recording", {}).items() if key not in ROTATION}
    for axis in tables["axis"]:
        axis.pop("reference", None)
    return tables


def experiment_plan(plan: Plan, axis: str, experiment: Experiment, seed: int) -> tuple[Plan, int]:
    """Return a copy of a plan whose axis plays the reference of an experiment, and its number of ticks.

    `seed` is the rig's seed, with which the lateness of its ticks is drawn. Raises ValueError for a duration or
    frequency that the rate does not allow.
    """
    table, generators = TableOfSamples(), plan.generators.copy()
    values = generator_values(experiment.reference, plan.pacing.rate_hz, (), Path(), table)
    index = plan.axes.index(axis)
    generators["kind"][index], generators["parameters"][index, : len(values) - 1] = values[0], values[1:]
    ticks = experiment.ticks(plan.pacing.rate_hz)
    pacing = replace(plan.pacing, lateness_seed=seed)
    return replace(plan, pacing=pacing, generators=generators, table=table.samples, ticks=ticks), ticks

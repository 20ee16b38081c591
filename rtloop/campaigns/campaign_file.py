"""CAMPAIGN.toml: a configuration, its uncertain keys, the experiments of every rig and the limits of their figures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, ValidationError, model_validator

from rtloop.campaigns.recorded_lateness import recorded_lateness
from rtloop.campaigns.rig_experiments import Experiment
from rtloop.campaigns.samples import Sampling
from rtloop.campaigns.uncertain import UncertainOptions
from rtloop.configuration.file import Configuration, describe, load
from rtloop.configuration.simulated import middle_um, sensor_ends_um
from rtloop.configuration.text_files import parse_toml, read_text
from rtloop.design.synthesis.specification_file import load_axis_specification, load_specification
from rtloop.design.verification.judgement import required_limits
from rtloop.errors import ConfigError
from rtloop.foundation.options import Options
from rtloop.laws.registry import LawReference

STEP_LIMITS = ("overshoot_percent", "settling_ms", "static_error_percent")
"""Limits of a specification that apply to experiments with steps."""
SEPARATOR = "."
"""Between the name of an experiment and the name of a figure."""


class CampaignOptions(Options):
    """The whole of CAMPAIGN.toml."""

    configuration: str
    """The configuration's file, relative to this file."""
    rigs: int = Field(default=1000, ge=1, le=10_000_000)
    """Number of sampled rigs, beside the nominal one."""
    seed: int = Field(default=0, ge=0)
    """Seed of all samples and of each rig's noise."""
    sampling: Sampling = "random"
    """Rule that draws the values of the keys: "random" for a yield, "sobol" and "latin_hypercube" to spread the rigs
    evenly, "saltelli" for Sobol's indices, which need 64 rigs or more for each key and two."""
    axis: str = ""
    """Axis that the experiments move; the first one by default."""
    specification: str = ""
    """Specification whose limits of steps apply, relative to this file; by default the axis's own."""
    lateness: str = ""
    """Recording of a paced run, relative to this file, whose lateness the ticks of every rig draw; by default none."""
    unit_rigs: int | None = Field(default=None, ge=1, le=100_000)
    """Rigs that a worker runs one after the other, and of one file of results; by default for about a second."""
    keep_worst: int = Field(default=3, ge=0, le=100)
    """Number of worst rigs that are run again and recorded."""
    uncertain: Annotated[dict[str, UncertainOptions], Field(min_length=1)]
    """Distribution of each uncertain key of the configuration."""
    experiment: Annotated[tuple[Experiment, ...], Field(strict=False, min_length=1)]
    """Experiments that every rig goes through, each from rest."""
    limits: dict[str, float] = Field(default_factory=dict)
    """Largest value of figures, by "EXPERIMENT.FIGURE"; they replace the specification's."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Return the options; ValueError for two experiments of one name, and for a limit of an unknown figure."""
        labels = [experiment.label for experiment in self.experiment]
        for label in labels:
            if labels.count(label) > 1:
                raise ValueError(f"experiment: two experiments have the name {label!r}; rename one of them")
        unknown = sorted(set(self.limits) - set(self.figures))
        if unknown:
            raise ValueError(f"limits: {', '.join(unknown)}; allowed: {', '.join(self.figures)}")
        return self

    @property
    def figures(self) -> tuple[str, ...]:
        """Names "EXPERIMENT.FIGURE" of all figures, in the order of the experiments."""
        return tuple(
            f"{experiment.label}{SEPARATOR}{figure}" for experiment in self.experiment for figure in experiment.figures
        )


@dataclass(frozen=True)
class Campaign:
    """A campaign as workers get it: its options, the text of its configuration, and the limits of its figures."""

    name: str
    options: CampaignOptions
    configuration_text: str
    configuration_name: str
    folder: Path
    """Folder of the configuration, for paths in it."""
    limits: Mapping[str, float]
    """Largest value of each limited figure."""
    laws: tuple[LawReference, ...] | None = None
    """Laws of the configuration, with the text of those from files; None where all are shipped or installed."""
    lateness_us: tuple[float, ...] = ()
    """Lateness of ticks, of which each tick of a rig draws one; empty: as the configuration says."""

    @property
    def digest(self) -> str:
        """SHA-256, in hexadecimal, of the options, the configuration's text, the limits, the laws and the lateness.

        Of the options, `keep_worst` and the paths of configuration and lateness do not count; `rigs` counts with Latin
        hypercubes alone.
        """
        left_out = {"keep_worst"} if self.options.sampling == "latin_hypercube" else {"keep_worst", "rigs"}
        left_out |= {"configuration", "lateness"}  # their content counts, not their paths
        laws = [law.sha256 for law in self.laws or ()]
        content = [
            self.options.model_dump(exclude=left_out),
            self.configuration_text,
            dict(self.limits),
            laws,
            *([self.lateness_us] if self.lateness_us else []),
        ]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def load_campaign(path: Path, rigs: int | None = None, configuration: Path | None = None) -> Campaign:
    """Return the campaign of the CAMPAIGN.toml at `path`, with the name "CAMPAIGN-CONFIGURATION".

    `rigs` replaces the number of sampled rigs, `configuration` the path of the configuration. Without a specification
    in the CAMPAIGN.toml, the limits come from the specification of this configuration's axis.

    Raises InputFileError for an unreadable file; ConfigError with all faults of the file or of its configuration, and
    for a recording without lateness; RecordingError for a file of `lateness` that is no recording.
    """
    try:
        raw = parse_toml(read_text(path))
    except ValueError as error:
        raise ConfigError(str(path), [str(error)]) from None
    try:
        options = CampaignOptions.model_validate(raw if rigs is None else {**raw, "rigs": rigs})
    except ValidationError as error:
        raise ConfigError(str(path), describe(error, "", raw, _collect_keys())) from None
    loaded = load(configuration or path.parent / options.configuration)
    names = [axis.name for axis in loaded.axes]
    if options.axis and options.axis not in names:
        raise ConfigError(str(path), [f"axis: {options.axis!r} is unknown; allowed: {', '.join(names)}"])
    axis = next(axis for axis in loaded.axes if options.axis in ("", axis.name))
    middle = middle_um(axis, sensor_ends_um(loaded, axis))
    experiments = tuple(experiment.about(middle) for experiment in options.experiment)
    return Campaign(
        f"{path.stem}-{loaded.name}",
        options.model_copy(update={"experiment": experiments}),
        loaded.text,
        loaded.name,
        loaded.folder,
        _limits(options, path, loaded),
        loaded.laws if any(law.text for law in loaded.laws) else None,
        recorded_lateness(path.parent / options.lateness) if options.lateness else (),
    )


def _limits(options: CampaignOptions, path: Path, configuration: Configuration) -> dict[str, float]:
    """Return the largest value of each limited figure, by "EXPERIMENT.FIGURE".

    [limits] in the file has priority; for experiments with steps, the specification adds its limits of overshoot,
    settling time and static error. The specification is the campaign's, else the axis's; without one, [limits] alone
    counts. Raises InputFileError and
    ConfigError for an unreadable or invalid specification.
    """
    axis = next(axis for axis in configuration.axes if options.axis in ("", axis.name))
    specification = load_specification(path.parent / options.specification) if options.specification else None
    if specification is None and axis.specification is not None:
        specification = load_axis_specification(configuration, axis)
    limits: dict[str, float] = {}
    if specification is not None:
        required = required_limits(specification.design.specification)
        limits = {
            f"{experiment.label}{SEPARATOR}{name}": required[name].value
            for experiment in options.experiment
            for name in STEP_LIMITS
            if experiment.kind == "steps" and name in required
        }
    return {**limits, **options.limits}


def _collect_keys() -> set[str]:
    """Return all keys that a CAMPAIGN.toml may have, at any depth, for suggestions in place of an unknown key."""
    schema = CampaignOptions.model_json_schema()
    parts = [schema, *schema.get("$defs", {}).values()]
    return set().union(*(part.get("properties", {}) for part in parts))

"""The experiments by name, in the order of a report, and the parsing of their parameters."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence

from pydantic import ValidationError

from rtloop.configuration.file import describe
from rtloop.errors import ConfigError
from rtloop.experiments.procedure import Experiment
from rtloop.experiments.procedures import (
    characterise,
    compensation,
    disturbance,
    harmonic,
    response,
    robustness,
    scan,
    sines,
    step_response,
    steps,
)
from rtloop.foundation.options import Options

MODULES = (characterise, step_response, compensation, steps, sines, harmonic, response, disturbance, robustness, scan)
EXPERIMENTS: dict[str, Experiment] = {module.EXPERIMENT.name: module.EXPERIMENT for module in MODULES}


def select_experiments(names: Sequence[str]) -> list[Experiment]:
    """Return the named experiments, and no others, in the order of a report. Raises ConfigError for an unknown name."""
    unknown = [name for name in names if name not in EXPERIMENTS]
    if unknown:
        known_names = ", ".join(EXPERIMENTS)
        raise ConfigError("experiment", [f"{name!r} is not an experiment; allowed: {known_names}" for name in unknown])
    return [experiment for name, experiment in EXPERIMENTS.items() if name in names]


def parse_parameters(experiments: Sequence[Experiment], settings: Sequence[str]) -> dict[str, Options]:
    """Return the options of each experiment by name, with the `settings` EXPERIMENT.KEY=VALUE applied.

    VALUE is written as in TOML. Raises ConfigError, with all faults, for a setting of another form, an EXPERIMENT that
    is not among `experiments`, an unknown KEY and a wrong VALUE.
    """
    raw_options: dict[str, dict[str, object]] = {experiment.name: {} for experiment in experiments}
    faults = []
    for setting in settings:
        key, equals, value = setting.partition("=")
        name, dot, option = key.strip().rpartition(".")
        if not equals or not dot or name not in raw_options:
            faults.append(
                f"--set {setting}; allowed: EXPERIMENT.KEY=VALUE with an EXPERIMENT from {', '.join(raw_options)}"
            )
            continue
        try:
            raw_options[name][option] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            faults.append(f"--set {setting}: {value!r}; allowed: a number, or numbers as in [1.0, 2.0]")
    options = {}
    for experiment in experiments:
        raw = raw_options[experiment.name]
        try:
            options[experiment.name] = experiment.options.model_validate(raw)
        except ValidationError as error:
            faults += describe(error, experiment.name, raw, set(experiment.options.model_fields))
    if faults:
        raise ConfigError("parameters of the experiments", faults)
    return options

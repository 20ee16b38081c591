"""An experiment: the runs that it asks of the loop, and the analysis of their recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration
from rtloop.errors import ConfigError
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Bound, Setting
from rtloop.experiments.timeline import Run
from rtloop.experiments.verdict import Analysis
from rtloop.foundation.options import Options


class UnsuitableLoop(Exception):
    """An experiment cannot be done with this loop, whatever its parameters; the message says why."""


@dataclass(frozen=True)
class Experiment:
    """A procedure and the analysis of its recordings.

    `runs(options, setting)` plans the runs, `analyse(runs, options)` evaluates them, `draw(figure, curves, palette)`
    draws.
    """

    name: str
    title: str
    description: str
    options: type[Options]
    runs: Callable[[Any, Setting], list[Run]]
    analyse: Callable[[Sequence[RecordedRun], Any], Analysis]
    draw: Callable[[Any, Mapping[str, Any], Any], None]
    next_run: Callable[[Sequence[RecordedRun], Any, Setting], Run | None] | None = None
    """Returns a further run, planned from the recordings so far; None at the end."""
    defaults: Mapping[str, Callable[[Setting], Any]] = field(default_factory=dict)
    """Values of options that are None unless a user sets them."""
    limits: Mapping[str, Callable[[Setting], Bound]] = field(default_factory=dict)
    """Largest magnitude of an option, by the option's key."""
    is_bipolar: bool = True
    """Whether it drives to both sides of 0 V."""
    needs_controller: bool = True
    needs_rig: bool = False
    """Whether it changes the simulated rig."""
    size: tuple[float, float] = (11.0, 5.0)
    """Width and height of the picture in inches."""

    def unsuitable_reason(self, configuration: Configuration, axis: AxisOptions, is_rig: bool) -> str | None:
        """Return why this experiment cannot be done on an axis of a configuration; None where it can.

        `is_rig`: the driver is a simulated rig that is built anew for each run.
        """
        axis_index = [axis_options.name for axis_options in configuration.axes].index(axis.name)
        if self.needs_controller and configuration.axes[configuration.owners[axis_index]].controller is None:
            return f"axis.{axis.name}.controller: missing; this experiment needs a closed loop"
        if self.is_bipolar and axis.limits.lowest_v == 0.0:
            return f"axis.{axis.name}.limits.drive_min_v: 0 V; this experiment needs a drive below 0 V"
        if self.needs_rig and not is_rig:
            kind = configuration.driver_kind
            return f"driver.kind: {kind!r}; this experiment changes the rig, which only the driver 'sim' allows"
        return None

    def fit_options(self, options: Options, setting: Setting, compared: Setting | None = None) -> Options:
        """Return the options with defaults for the axis, scaled down to its limits unless a user set them.

        They keep the limits of a `compared` setting, too. Raises ConfigError for values that a user set beyond the
        limits.
        """
        changes = {key: default(setting) for key, default in self.defaults.items() if getattr(options, key) is None}
        faults = []
        for key, bound_of_setting in self.limits.items():
            value = changes.get(key, getattr(options, key))
            magnitude, (limit, reason) = float(np.max(np.abs(value))), bound_of_setting(setting)
            place = f"axis.{setting.axis.name}.{reason}"
            if compared is not None and (bound := bound_of_setting(compared))[0] < limit:
                limit, place = bound[0], f"axis.{compared.axis.name}.{bound[1]} of the configuration after --beside"
            if magnitude <= limit:
                continue
            if key in options.model_fields_set:
                unit = " µm" if key.endswith("_um") else ""
                allowed = f"allowed: up to {limit:.4g}{unit}, by {place}"
                faults.append(f"{self.name}.{key}: {magnitude:g}{unit}; {allowed}")
                continue
            step = 10.0 ** (math.floor(math.log10(limit)) - 1)
            scale = math.floor(limit / step) * step / magnitude
            changes[key] = tuple(scale * number for number in value) if isinstance(value, tuple) else scale * value
        if faults:
            raise ConfigError("parameters of the experiments", faults)
        return options.model_copy(update=changes)

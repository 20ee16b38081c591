"""An experiment: the runs that it asks of the loop, and the analysis of their recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.file import Configuration
from rtloop.errors import ConfigError
from rtloop.experiments.recorded_run import RecordedRun
from rtloop.experiments.setting import Bound, Setting
from rtloop.experiments.timeline import Run
from rtloop.experiments.verdict import Analysis, Curves
from rtloop.foundation.options import Options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rtloop.design.palette import Palette

Chosen = TypeVar("Chosen", bound=Options)


class UnsuitableLoop(Exception):
    """An experiment cannot be done with this loop, whatever its parameters; the message says why."""


LEAST_SHARE = 1e-3
"""Least share of its default to which an option is reduced: with a smaller signal the experiment shows no result."""


@dataclass(frozen=True)
class Experiment(Generic[Chosen, Curves]):
    """A procedure and the analysis of its recordings.

    `runs(options, setting)` plans the runs, `analyse(runs, options)` evaluates them, `draw(figure, curves, palette)`
    draws.
    """

    name: str
    title: str
    description: str
    options: type[Chosen]
    runs: Callable[[Chosen, Setting], list[Run]]
    analyse: Callable[[Sequence[RecordedRun], Chosen], Analysis[Curves]]
    draw: Callable[[Figure, Curves, Palette], None]
    next_run: Callable[[Sequence[RecordedRun], Chosen, Setting], Run | None] | None = None
    """Returns a further run, planned from the recordings so far; None at the end."""
    defaults: Mapping[str, Callable[[Setting], float | tuple[float, ...]]] = field(default_factory=dict)
    """Values of options that are None unless a user sets them."""
    limits: Mapping[str, Callable[[Setting], Bound]] = field(default_factory=dict)
    """Largest magnitude of an option, by the option's key."""
    lower_limits: Mapping[str, Callable[[Setting], Bound]] = field(default_factory=dict)
    """Largest magnitude of an option's negative numbers, by its key; `limits` is used for a key without an entry."""
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
        if self.needs_rig and not is_rig:
            kind = configuration.driver_kind
            return f"driver.kind: {kind!r}; allowed: 'sim', because this experiment changes the simulated rig"
        return None

    def fit_options(self, options: Options, setting: Setting, compared: Setting | None = None) -> Options:
        """Return a copy of the options: absent defaults filled in for the axis, all defaults scaled down to its limits.

        Options that a user set stay unchanged. The limits of a `compared` setting, unless it is None, hold too. Raises
        ConfigError for values that a user set beyond the limits, UnsuitableLoop if less than LEAST_SHARE of a default
        would remain.
        """
        return self._fit(options, setting, compared)[0]

    def reductions(self, options: Options, setting: Setting, compared: Setting | None = None) -> list[str]:
        """Return a text for each default that `fit_options` scales down: its key, new and old value, and the limit.

        Raises ConfigError and UnsuitableLoop as `fit_options`.
        """
        return self._fit(options, setting, compared)[1]

    def _fit(self, options: Options, setting: Setting, compared: Setting | None) -> tuple[Options, list[str]]:
        """Return a fitted copy of the options, and a text for each default that was scaled down.

        Raises ConfigError for values that a user set beyond the limits, UnsuitableLoop for a default of which less than
        LEAST_SHARE would remain.
        """
        changes = {key: default(setting) for key, default in self.defaults.items() if getattr(options, key) is None}
        faults, reductions = [], []
        for key in self.limits:
            value = changes.get(key, getattr(options, key))
            unit = " µm" if key.endswith("_um") else ""
            bounds = [self._bound(key, sign, setting, compared) for sign in (1.0, -1.0)]
            magnitudes = [float(np.max(sign * np.asarray(value))) for sign in (1.0, -1.0)]
            exceeding = [
                (magnitude, *bound) for magnitude, bound in zip(magnitudes, bounds, strict=True) if magnitude > bound[0]
            ]
            if not exceeding:
                continue
            magnitude, limit, place = exceeding[0]
            if key in options.model_fields_set:
                allowed = f"allowed: up to {limit:.4g}{unit}, limited by {place}"
                faults.append(f"{self.name}.{key}: {magnitude:g}{unit}; {allowed}")
                continue
            if limit < LEAST_SHARE * magnitude:
                raise UnsuitableLoop(
                    f"{self.name}.{key}: {magnitude:g}{unit}; allowed: up to {limit:.2g}{unit}, limited by {place}"
                )
            changes[key] = _scale_down(value, [bound[0] for bound in bounds])
            old_text, new_text = _value_text(value), _value_text(changes[key])
            reductions.append(f"{self.name}.{key}: {new_text}{unit} (default: {old_text}{unit}), limited by {place}")
        if faults:
            raise ConfigError("parameters of the experiments", faults)
        return options.model_copy(update=changes), reductions

    def _bound(self, key: str, sign: float, setting: Setting, compared: Setting | None) -> tuple[float, str]:
        """Return the largest allowed magnitude of an option's positive (`sign` 1) or negative (−1) numbers.

        A text follows it: the configuration key, with its value, that sets this limit. `key` is the option's key. The
        smaller limit of `setting` and, unless it is None, of `compared` counts.
        """
        bound_of_setting = self.limits[key] if sign > 0 else self.lower_limits.get(key, self.limits[key])
        limit, reason = bound_of_setting(setting)
        place = f"axis.{setting.axis.name}.{reason}"
        if compared is not None and (bound := bound_of_setting(compared))[0] < limit:
            return bound[0], f"axis.{compared.axis.name}.{bound[1]} of the second configuration (--beside)"
        return limit, place


def _scale_down(value: object, limits: Sequence[float]) -> float | tuple[float, ...]:
    """Return a number, or a tuple of numbers, scaled down to `limits`.

    `limits` are the largest magnitudes allowed for positive and for negative numbers, in this order. They are first
    rounded down to two significant digits. Equal limits scale all numbers by one factor, unequal limits each sign by a
    separate one; no factor is above 1.
    """
    numbers = np.atleast_1d(np.asarray(value, dtype=float))
    rounded = [_round_down(limit) for limit in limits]
    largest = [float(np.max(sign * numbers, initial=0.0)) for sign in (1, -1)]
    factors = [min(limit / peak, 1.0) if peak else 1.0 for limit, peak in zip(rounded, largest, strict=True)]
    if math.isclose(*limits, rel_tol=1e-6):
        factors = 2 * [min(factors)]
    scaled = tuple((factors[0] if number > 0 else factors[1]) * number for number in numbers.tolist())
    return scaled if isinstance(value, tuple) else scaled[0]


def _round_down(limit: float) -> float:
    """Return a number rounded down to two significant digits; 0 for one that is not above 0."""
    if limit <= 0.0:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(limit)) - 1)
    return math.floor(limit / step) * step


def _value_text(value: object) -> str:
    """Return as text a number, or a tuple of numbers separated by commas, with four significant digits each."""
    return ", ".join(f"{number:.4g}" for number in (value if isinstance(value, tuple) else (value,)))

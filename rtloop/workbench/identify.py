"""`rtloop.identify`: a model of the actuator's hysteresis, or of an axis's dynamics, from recordings."""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
from typing import Any, Literal, get_args, overload

from rtloop.design.identification.dynamics.identify_dynamics import Criterion
from rtloop.design.identification.dynamics.recorded_loop import State
from rtloop.design.identification.hysteresis.recording_set import Weights
from rtloop.design.identification.hysteresis.thresholds import Placement
from rtloop.recording.load import Recording
from rtloop.workbench.arguments import (
    FileName,
    as_path,
    require_choice,
    require_count,
    require_names,
    require_numbers,
    single_files,
)
from rtloop.workbench.dynamics import DynamicsResult, Input, fit_dynamics
from rtloop.workbench.hysteresis import HysteresisResult, Memory, fit_hysteresis

RecordedRun = FileName | Recording
"""A recording of one file, loaded or by its name."""
CHOICES = {"placement": Placement, "weights": Weights, "memory": Memory, "input": Input, "loop": State}
"""Allowed values of the options that are a choice."""
COUNTS = {"operators": (1, 64), "order": (1, 20), "largest_order": (1, 20), "delay": (0, 16)}
"""Least and largest value of the options that are counts; None for `order` and `delay` lets them be searched."""
SEARCHED = ("order", "delay")


@overload
def identify(
    recordings: RecordedRun | Sequence[RecordedRun],
    kind: Literal["hysteresis"] = "hysteresis",
    *,
    axis: str | None = None,
    operators: int = 15,
    placement: Placement = "auto",
    thresholds: Sequence[float] | None = None,
    weights: Weights = "invertible",
    memory: Memory = "auto",
    validate: RecordedRun | Sequence[RecordedRun] = (),
) -> HysteresisResult: ...
@overload
def identify(
    recordings: RecordedRun | Sequence[RecordedRun],
    kind: Literal["dynamics"],
    *,
    axis: str | None = None,
    hysteresis: FileName | None = None,
    input: Input = "hysteresis",
    order: int | None = None,
    largest_order: int = 14,
    delay: int | None = None,
    criterion: Criterion | None = None,
    loop: State = "auto",
    outside: Sequence[str] = (),
    detrend: bool = False,
    compare: RecordedRun | None = None,
) -> DynamicsResult: ...
def identify(recordings: object, kind: str = "hysteresis", **options: Any) -> HysteresisResult | DynamicsResult:
    """Identify the actuator's hysteresis, or the dynamics of an axis (`kind` "dynamics"), from recordings.

    Hysteresis is fitted to all recordings; dynamics are fitted to the first and validated with the others. No file is
    written.
    `options` have the names of the options of `rtloop identify hysteresis` and `rtloop identify dynamics`, with `_` for
    `-`: operators, placement, thresholds (V), weights, memory, validate; and hysteresis, input, order, largest_order,
    delay (samples), criterion, loop, outside, detrend, compare; axis for both. Raises UnsuitableData for recordings
    that tell too little, RecordingError for files that cannot be read, ConfigError where no model can be fitted,
    RtloopError for a kind or an option that is not allowed.
    """
    require_choice(kind, "identify: kind", ("hysteresis", "dynamics"))
    fit = fit_hysteresis if kind == "hysteresis" else fit_dynamics
    allowed = [name for name in signature(fit).parameters if name not in ("paths", "warn")]
    for name, value in options.items():
        require_choice(name, f"identify: option of kind {kind!r}", allowed)
        options[name] = _checked_option(name, value)
    return fit(single_files(recordings, "identify: recordings"), **options)


def _checked_option(name: str, value: object) -> object:
    """Return the value of option `name`, with recordings and files as paths.

    Raises RtloopError for a value that is not allowed. The name, and the value of `axis`, are not checked.
    """
    where = f"identify: {name}"
    if name in CHOICES:
        require_choice(value, where, get_args(CHOICES[name]))
    elif name == "criterion" and value is not None:
        require_choice(value, where, get_args(Criterion))
    elif name in COUNTS and not (name in SEARCHED and value is None):
        require_count(value, where, *COUNTS[name])
    elif name == "validate":
        return [] if isinstance(value, list | tuple) and not value else single_files(value, where)
    elif name == "compare" and value is not None:
        return single_files(value, where)[0]
    elif name == "hysteresis" and value is not None:
        return as_path(value, where)
    elif name == "thresholds" and value is not None:
        return require_numbers(value, where)
    elif name == "outside":
        return require_names(value, where)
    return value

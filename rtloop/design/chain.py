"""From two recordings and a specification to a configuration that runs: the whole design in one call.

    slow sine ──► hysteresis P̂ ─┬─► [axis.feedforward] ──────────┐
    step ───────────────────────┴─► D(s), D(0) = 1 ─► [axis.model] ─► H∞, reduction ─► [axis.controller]

Driver, limits and interlocks are those of the configuration that the step was recorded with.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtloop.analysis.comparison import LIGHT_DAMPING
from rtloop.configuration.axis import ModelOptions
from rtloop.design.identification.identified import (
    dynamics_provenance,
    feedforward_section,
    hysteresis_provenance,
    model_values,
    with_gain,
)
from rtloop.design.identification.identify_dynamics import DynamicsFit, Excitation, identify_dynamics
from rtloop.design.identification.identify_hysteresis import HysteresisFit, identify_hysteresis
from rtloop.design.identification.measured import Measured, UnsuitableData, noise_of
from rtloop.design.synthesis.section import controller_section
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.design.synthesis.synthesise import Synthesis, synthesise_design
from rtloop.design.toml_text import edited
from rtloop.hysteresis.plays import model_output
from rtloop.laws.shipped.play_model import PlayModel

LARGEST_ERROR, SMALL_PART = 3.0, 3e-4
"""A loop is not designed on a model whose prediction errs by more than so many times the noise, or times this part of
all that the position moved, which the model of the hysteresis may leave."""
AT_REST = {"kind": "hold", "value": 0.0}
SWINGS = 8
"""Swings of a light mode, each within one and a half times its own time, that trip the loop which is written."""


@dataclass(frozen=True)
class Chain:
    """What every step found; `actuator` is the hysteresis with the static gain of the dynamics in it."""

    hysteresis: HysteresisFit
    dynamics: DynamicsFit
    actuator: PlayModel
    design: DesignOptions
    synthesis: Synthesis


def designed(hysteresis: Measured, step: Measured, design: DesignOptions, order: int | None = None) -> Chain:
    """Identify from two recordings and synthesise for `design`, whose plant is replaced by the identified one.

    Raises UnsuitableData where a recording cannot serve, NoController and ValueError as the synthesis does.
    """
    if not step.even:
        raise UnsuitableData(f"{step.name}: ticks are missing or late by a period; dynamics need equal intervals")
    shape = identify_hysteresis([hysteresis])
    excitation = Excitation(step.name, model_output(shape.model, step.drive_v), step.position_um, step.period_s)
    dynamics = identify_dynamics(excitation, order, criterion="held-out")
    _require_explained(step, dynamics)
    plant = ModelOptions.model_validate(model_values(dynamics))
    output = design.controller.model_copy(update={"rate_hz": 1 / step.period_s})
    asked = design.model_copy(update={"plant": plant, "controller": output})
    return Chain(shape, dynamics, with_gain(shape.model, dynamics.static_gain), asked, synthesise_design(asked))


def _require_explained(step: Measured, dynamics: DynamicsFit) -> None:
    """Raise UnsuitableData for a model that misses more of its recording than noise and hysteresis leave."""
    allowed_um = LARGEST_ERROR * max(noise_of(step.position_um), SMALL_PART * float(np.ptp(step.position_um)))
    if dynamics.rms_error_um > allowed_um:
        raise UnsuitableData(
            f"{step.name}: no model explains it: that of order {dynamics.model.order} behind {dynamics.delay_ticks} "
            f"samples errs by {dynamics.rms_error_um:.3g} µm rms, and {allowed_um:.3g} µm is allowed (about "
            f"{LARGEST_ERROR:g} times the noise). A step up and down, a larger one, or a longer record would help"
        )


def configuration_text(
    chain: Chain, hysteresis: Measured, step: Measured, axis: str | None, spec_name: str, spec_text: str
) -> str:
    """A complete configuration: that of `step` with what was found in axis `axis` (the first), in closed loop, at rest.

    `spec_name` is the specification's file relative to the configuration's. Raises UnsuitableData for weights without
    an inverse.
    """
    raw = tomllib.loads(step.configuration)
    raw["loop"] = {key: value for key, value in raw["loop"].items() if key != "mode"}
    raw.pop("schedule", None)
    written = controller_section(chain.synthesis, chain.design, spec_name, spec_text)
    comments = [line.removeprefix("# ") for line in written.splitlines() if line.startswith("#")]
    parts = {
        "feedforward": _section(feedforward_section(chain.actuator, ()), "feedforward"),
        "controller": _section(written, "controller"),
        "model": model_values(chain.dynamics),
        "specification": spec_name,
        "reference": AT_REST,
    }
    chosen = _chosen(raw["axis"], axis)
    parts["interlocks"] = _with_oscillation(chosen.get("interlocks", {}), chain.dynamics, step.period_s)
    raw["axis"] = [{**one, **parts} if one is chosen else one for one in raw["axis"]]
    heading = [
        *hysteresis_provenance(chain.hysteresis, [hysteresis]),
        *dynamics_provenance(chain.dynamics, step, "hysteresis"),
        *comments,
    ]
    return edited(step.configuration, raw, heading)


def _with_oscillation(interlocks: Mapping[str, Any], dynamics: DynamicsFit, period_s: float) -> dict[str, Any]:
    """The interlocks with that against a growing resonance on: it is off where a stage shall ring without control."""
    lowest_hz = min((mode.frequency_hz for mode in dynamics.modes if mode.damping < LIGHT_DAMPING), default=None)
    if lowest_hz is None or interlocks.get("oscillation_swings", 0):
        return dict(interlocks)
    return {**interlocks, "oscillation_swings": SWINGS, "swing_ticks": math.ceil(0.75 / (lowest_hz * period_s))}


def _section(content: str, name: str) -> Any:
    return tomllib.loads(content)["axis"][name]


def _chosen(axes: list[Any], name: str | None) -> Any:
    return next(one for one in axes if name in (None, one["name"]))

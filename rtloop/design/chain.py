"""Design of a loop in one call: two recordings and a specification become a configuration that runs.

    slow sine ──► hysteresis P̂ ─┬─► [axis.feedforward] ──────────┐
    step ───────────────────────┴─► D(s), D(0) = 1 ─► [axis.model] ─► H∞, reduction ─► [axis.controller]

Driver, limits and interlocks come from the configuration that the step was recorded with. `robust.chain` continues
from the model with a damping controller and reference taps instead of H∞ synthesis.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtloop.analysis.comparison import LIGHT_DAMPING
from rtloop.configuration.axis import LimitsOptions, ModelOptions
from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData, jumps, noise_std
from rtloop.design.identification.dynamics.beginning import refer_to_beginning
from rtloop.design.identification.dynamics.dynamics_fit import DynamicsFit, Mode
from rtloop.design.identification.dynamics.identify_in_loop import identify_recorded_dynamics
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.design.identification.hysteresis.identify_hysteresis import identify_hysteresis
from rtloop.design.identification.hysteresis.recording_set import HysteresisFit
from rtloop.design.identification.model_sections import (
    dynamics_provenance,
    feedforward_values,
    hysteresis_provenance,
    left_out_text,
    model_values,
    scale_hysteresis,
)
from rtloop.design.stale_comments import remove_first_comments
from rtloop.design.synthesis.section import controller_values, provenance
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.design.synthesis.synthesise import Synthesis, synthesise_design
from rtloop.design.toml_text import edit_text
from rtloop.design.written_reference import StepsReference, steps_reference
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output
from rtloop.values import count_text

LARGEST_NOISE_RATIO, HYSTERESIS_SHARE = 3.0, 3e-4
"""Largest rms prediction error of a model that a loop is designed on: a multiple of the noise, or if larger, of
HYSTERESIS_SHARE times the range of the modelled hysteresis in the step, an error that its model may leave.
"""
DWELL_SWINGS, DWELL_DECAYS = 50, 5
"""Duration of each level of the written reference, in periods or, if less, in decay times of the slowest mode."""
CREEP_SHARE = 0.1
"""Share of D(0) of a well damped mode, below which it counts as creep, which the reference does not wait for."""
SWINGS = 8
"""Swings of the slowest lightly damped mode that trip the written loop, each at most 3/4 of its period after the last.
"""


@dataclass(frozen=True)
class Stage:
    """Stage identified from two recordings: `slow` of a slow sine, `fast` of a step.

    `actuator` is the hysteresis scaled by the static gain of the dynamics.
    """

    slow: AxisRecording
    fast: AxisRecording
    hysteresis: HysteresisFit
    dynamics: DynamicsFit
    actuator: PlayModel

    def complete_design(self, design: DesignOptions) -> DesignOptions:
        """Return a copy of `design` with the identified model as `plant`, and the step recording's rate as
        `controller.rate_hz`.
        """
        plant = ModelOptions.model_validate(model_values(self.dynamics))
        output = design.controller.model_copy(update={"rate_hz": 1 / self.fast.period_s})
        return design.model_copy(update={"plant": plant, "controller": output})

    def describe(self) -> str:
        """Return one line of text: relative height h/H of the modelled hysteresis loop (%), modes (Hz, ζ), delay,
        error of the hysteresis at the levels of the step, and modes that were left out.
        """
        modes = ", ".join(f"{mode.frequency_hz:.1f} Hz (ζ {mode.damping:.4f})" for mode in self.dynamics.modes)
        delay = f"{count_text(self.dynamics.delay_ticks, 'sample')} of delay"
        text = f"hysteresis h/H {self.hysteresis.model_loop.percent:.2f} %; modes at {modes}; {delay}"
        if self.dynamics.level_correction:
            text += f"; the hysteresis model errs by up to {self.dynamics.level_correction:.2g} µm at the step's levels"
        if self.dynamics.left_out_hz:
            text += f"; {left_out_text(self.dynamics.left_out_hz)}"
        return text


@dataclass(frozen=True)
class Chain:
    """Results of all design steps."""

    stage: Stage
    design: DesignOptions
    synthesis: Synthesis


def identify_stage(hysteresis: AxisRecording, step: AxisRecording, order: int | None = None) -> Stage:
    """Identify the stage from two recordings, with `order` poles (None: chosen by held-out errors).

    `hysteresis` records a slow sine, `step` a step of the drive. Raises UnsuitableData for a step without a
    configuration, as in an imported file, if ticks of the step are missing or late, if no model explains the step, and
    as `identify_hysteresis` and `identify_recorded_dynamics`; the message calls the recordings swapped if `hysteresis`
    has steps of the drive and `step` has none. Raises ArithmeticError for a model with an unstable predictor.
    """
    try:
        return _identify_stage(hysteresis, step, order)
    except UnsuitableData as error:
        if not jumps(hysteresis) or jumps(step):
            raise
        raise UnsuitableData(
            f"the two recordings seem to be swapped: {hysteresis.name} has steps of the drive, {step.name} has none. "
            f"Give the recording of the slow sine first, then the recording of the step. Error in this order: {error}"
        ) from None


def _identify_stage(hysteresis: AxisRecording, step: AxisRecording, order: int | None) -> Stage:
    """Identify the stage, and raise errors, as `identify_stage` does, but never call the recordings swapped."""
    if not step.configuration:
        raise UnsuitableData(
            f"{step.name}: an imported recording has no configuration; the design takes driver and limits of the new "
            "loop from the configuration. Record the step with `rtloop run`, or design from the imported recordings "
            "with `rtloop identify hysteresis`, `rtloop identify dynamics` and `rtloop design synthesise`"
        )
    if not step.is_even:
        raise UnsuitableData(
            f"{step.name}: ticks are missing or late by a period; identification of dynamics needs samples at equal "
            "intervals. Record again with --unpaced or with real-time scheduling"
        )
    fit = identify_hysteresis([hysteresis])
    excitation = Excitation(step.name, model_output(fit.model, step.drive_v), step.position_um, step.period_s)
    dynamics = identify_recorded_dynamics(refer_to_beginning(excitation, begins_at_0=True), order)
    noise_um = min(noise_std(step.position_um), noise_std(hysteresis.position_um))
    _require_explained(step, dynamics, max(noise_um, HYSTERESIS_SHARE * float(np.ptp(excitation.input))))
    return Stage(hysteresis, step, fit, dynamics, scale_hysteresis(fit.model, dynamics.static_gain))


def design_controller(stage: Stage, design: DesignOptions) -> Chain:
    """Synthesise a controller for `design`, with the identified plant at the step recording's rate; return all results.

    Raises as `synthesise_design`: NoController for a specification that no controller meets, ValueError for an
    incomplete one.
    """
    completed = stage.complete_design(design)
    return Chain(stage, completed, synthesise_design(completed))


def _require_explained(step: AxisRecording, dynamics: DynamicsFit, noise_um: float) -> None:
    """Raise UnsuitableData if the rms prediction error of `dynamics` exceeds LARGEST_NOISE_RATIO times `noise_um`."""
    allowed_um = LARGEST_NOISE_RATIO * noise_um
    if dynamics.rms_error_um > allowed_um:
        raise UnsuitableData(
            f"{step.name}: no model explains the step. The best model has order {dynamics.model.order}, "
            f"{count_text(dynamics.delay_ticks, 'sample')} of delay and an error of {dynamics.rms_error_um:.3g} µm "
            f"rms; allowed: up to {allowed_um:.3g} µm, about {LARGEST_NOISE_RATIO:g} times the noise. Use a step up "
            "and down, a larger step, or a longer recording"
        )


def configuration_text(chain: Chain, axis: str | None, spec_name: str, spec_text: str) -> str:
    """Return as TOML the step recording's configuration in closed loop, with the design in `axis`.

    `axis` is the name of one of the recording's axes, None the first. `spec_name` is the specification's path relative
    to the configuration, `spec_text` its content, whose SHA-256 is in a comment. Raises UnsuitableData for weights of
    the hysteresis without an inverse.
    """
    parts = {"controller": controller_values(chain.synthesis.controller, chain.design.controller)}
    comments = provenance(chain.synthesis, chain.design, spec_name, spec_text)
    return stage_configuration(chain.stage, parts, comments, axis, spec_name)


def stage_configuration(
    stage: Stage, parts: Mapping[str, object], comments: list[str], axis: str | None, spec_name: str
) -> str:
    """Return as TOML the step recording's configuration in closed loop, with the stage in `axis`.

    `axis` is the name of one of the recording's axes, None the first. This axis receives feedforward and model of the
    identified stage, a reference of steps, the interlock against oscillation (`_enable_oscillation`), the
    specification's path `spec_name`, and the sections of `parts`, by name. [schedule] is left out. The text begins with
    comments on the identification, then `comments`.
    Raises UnsuitableData for weights of the hysteresis without an inverse.
    """
    configuration = tomllib.loads(stage.fast.configuration)
    configuration["loop"] = {key: value for key, value in configuration["loop"].items() if key != "mode"}
    configuration.pop("schedule", None)
    sections = {
        "feedforward": feedforward_values(stage.actuator),
        "model": model_values(stage.dynamics),
        "specification": spec_name,
        **parts,
    }
    axis_table = _axis_table(configuration, axis)
    sections["reference"] = reference_values(stage, axis)
    rewritten = [*sections]
    sections["interlocks"] = _enable_oscillation(axis_table.get("interlocks", {}), stage.dynamics, stage.fast.period_s)
    configuration["axis"] = [{**table, **sections} if table is axis_table else table for table in configuration["axis"]]
    heading = [
        *hysteresis_provenance(stage.hysteresis, [stage.slow]),
        *dynamics_provenance(stage.dynamics, stage.fast, "hysteresis"),
        *comments,
    ]
    return edit_text(remove_first_comments(stage.fast.configuration), configuration, heading, rewritten)


def reference_values(stage: Stage, axis: str | None) -> StepsReference:
    """Return the table [axis.reference], a square wave as `steps_reference` makes, for the step recording's axis.

    It is {"kind": "steps", "levels": two in µm, "dwell_s": the duration of each}. `axis` is the name of one of the
    recording's axes, None the first. Raises ValueError for weights of the hysteresis without an inverse.
    """
    limits = LimitsOptions.model_validate(_axis_table(tomllib.loads(stage.fast.configuration), axis).get("limits", {}))
    return steps_reference(limits, stage.actuator, dwell_s(stage.dynamics.modes), stage.fast.period_s)


def dwell_s(modes: Sequence[Mode]) -> float:
    """Return the duration of a level in s in which modes settle: DWELL_SWINGS periods, or if less DWELL_DECAYS decay
    times 1/|Re s|, of the slowest one. A well damped mode of less than CREEP_SHARE of D(0) does not count: it is of
    creep, which a loop need not wait for.
    """
    return max(
        (
            min(DWELL_SWINGS, DWELL_DECAYS / (2 * math.pi * mode.damping)) / mode.frequency_hz
            for mode in modes
            if mode.damping < LIGHT_DAMPING or mode.static_share >= CREEP_SHARE
        ),
        default=0.0,
    )


def _axis_table(configuration: Mapping[str, Any], axis: str | None) -> dict[str, Any]:
    """Return the table of the axis named `axis` (None: the first), not a copy. The axis must exist."""
    return next(table for table in configuration["axis"] if axis in (None, table["name"]))


def _enable_oscillation(interlocks: Mapping[str, object], dynamics: DynamicsFit, period_s: float) -> dict[str, object]:
    """Return a copy of [axis.interlocks] with the interlock against a growing resonance enabled: `oscillation_swings`
    is SWINGS, `swing_ticks` is 3/4 of the period of the slowest lightly damped mode, in ticks.

    The copy is unchanged without a lightly damped mode, or if `oscillation_swings` is above 0 already.
    """
    lowest_hz = min((mode.frequency_hz for mode in dynamics.modes if mode.damping < LIGHT_DAMPING), default=None)
    if lowest_hz is None or interlocks.get("oscillation_swings", 0):
        return dict(interlocks)
    return {**interlocks, "oscillation_swings": SWINGS, "swing_ticks": math.ceil(0.75 / (lowest_hz * period_s))}

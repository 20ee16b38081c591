"""The axes of a configuration judged by their specifications: by their linear loops and on simulated rigs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rtloop.analysis.perturbation import resonance_hz
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.checks import AxisCheck
from rtloop.configuration.file import Configuration
from rtloop.configuration.simulated import compare_with_rig
from rtloop.design.robust.scenarios import Family
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.design.synthesis.specification_file import load_axis_specification, load_specification
from rtloop.design.verification.bench import Bench, HardwareModel
from rtloop.design.verification.robustness import Plants
from rtloop.design.verification.simulation import simulate
from rtloop.design.verification.verify import Verification, VerifiedLoop, verify
from rtloop.errors import ConfigError, RtloopError
from rtloop.linear.transfer import Transfer
from rtloop.supervision.host_delay import load_host_delay, spent_margin

SAME_PLANT, SAME_RESPONSE = 1e-3, 0.02
"""Relative differences up to which figures of two plants, and their frequency responses, are the same."""


def _scenario_plants(design: DesignOptions, plant: Transfer, delay_ticks: int, period_s: float) -> Plants:
    """Return label, plant and delay in samples of each corner of [scenarios]; () without that section."""
    if "scenarios" not in design.model_fields_set:
        return ()
    family = Family(plant, delay_ticks, design.scenarios, period_s)
    return [(str(scenario), family.plant(scenario), scenario.delay_ticks) for scenario in family.corner_scenarios()]


def verify_axis(
    configuration: Configuration, check: AxisCheck, spec: Path | None
) -> tuple[Verification, DesignOptions]:
    """Judge an axis by the specification at `spec`, or for None by its own; without one, by no requirement.

    Returns the verification and the options of the specification. Raises ConfigError without a model of the plant, for
    an invalid specification and for a plant that `verify` refuses; InputFileError for a specification that cannot be
    read.
    """
    axis = next(entry for entry in configuration.axes if entry.name == check.name)
    if spec is not None:
        design = load_specification(spec).design
    elif axis.specification is not None:
        design = load_axis_specification(configuration, axis).design
    else:
        design = DesignOptions()
    model, key = axis.model or design.plant, f"axis.{axis.name}"
    if model is None:
        raise ConfigError(
            configuration.source, [f"{key}.model: missing; set [axis.model], or [plant] in the specification"]
        )
    margins = None if check.together is None else check.together.margins
    try:
        subject = VerifiedLoop(check.loop, check.controller, check.discrete)
        plant, delay = model.transfer(), max(model.delay_ticks, check.delay_ticks)
        plants = _scenario_plants(design, plant, delay, 1 / configuration.loop.rate_hz)
        host = load_host_delay(configuration)
        verification = verify(subject, plant, design, delay, margins, plants)
        verification = replace(verification, host=None if host is None else spent_margin(check, host))
        warnings = (*verification.warnings, *_plant_differences(axis, design))
        verification = replace(verification, warnings=warnings)
        return _add_contradictions(verification, configuration, check, design), design
    except ValueError as error:
        raise ConfigError(configuration.source, [f"{key}: {error}"]) from None


def _plant_differences(axis: AxisOptions, design: DesignOptions) -> list[str]:
    """Return one sentence if the model of an axis, which is judged, differs from the plant of its specification.

    [] if it does not, and if one of them is missing.

    The sentence names gain at 0 Hz, resonance and delay where they differ by more than SAME_PLANT. If none does, it
    names the frequency, up to ten times the resonance (10 kHz without one), at which the responses differ most, if by
    more than SAME_RESPONSE.
    """
    if axis.model is None or design.plant is None:
        return []
    plants, named = [model.transfer() for model in (axis.model, design.plant)], dict[str, tuple[float, ...]]()
    named["gain at 0 Hz"] = tuple(plant.dc_gain for plant in plants)
    named["resonance in Hz"] = tuple((resonance_hz(plant) or (0.0, 0.0))[0] for plant in plants)
    named["delay_ticks"] = (axis.model.delay_ticks, design.plant.delay_ticks)
    differences = [
        f"{name} {values[0]:.6g}, in the specification {values[1]:.6g}"
        for name, values in named.items()
        if abs(values[0] - values[1]) > SAME_PLANT * max(map(abs, values))
    ]
    if not differences:
        peak_hz = named["resonance in Hz"][0] or 1e3
        hz = np.append(np.geomspace(0.1, 10 * peak_hz, 500), peak_hz)
        model_response, response = (plant.response(2j * np.pi * hz) for plant in plants)
        ratios = np.abs(model_response - response) / np.abs(response)
        if ratios[largest := int(np.argmax(ratios))] > SAME_RESPONSE:
            differences = [f"response at {hz[largest]:.4g} Hz, by {100 * ratios[largest]:.3g} %"]
    if not differences:
        return []
    differences_text = "; ".join(differences)
    return [
        f"axis.{axis.name}.model: differs from [plant] of the specification: {differences_text}. The verification "
        f"judges axis.{axis.name}.model, not [plant]"
    ]


def _add_contradictions(
    verification: Verification, configuration: Configuration, check: AxisCheck, design: DesignOptions
) -> Verification:
    """Return the verification with the contradictions between axis and hardware, also as warnings, and with the loop
    judged on the simulated rig.

    Its `on_rig` is None for drivers other than a simulated rig, for an axis without a linear loop on its own
    model, and without a contradiction if the loop is stable on the rig. Raises ValueError for a rig's plant with direct
    feedthrough.
    """
    axis = next(axis for axis in configuration.axes if axis.name == check.name)
    (lines, on_rig), rig_verification = compare_with_rig(configuration, axis, check), None
    if fault := verification.running.reference_fault:
        lines = [*lines, f"axis.{axis.name}.controller: the law is not linear in the reference: {fault}"]
    if on_rig is not None and on_rig.plant is not None:
        sensor = design.sensor.model_copy(update={"bandwidth_hz": None})  # the rig's plant has its sensor's lag
        rig_design = design.model_copy(update={"sensor": sensor})
        rig_verification = verify(VerifiedLoop(on_rig.loop), on_rig.plant, rig_design, on_rig.delay_ticks)
    warnings = (*verification.warnings, *lines)
    return replace(verification, contradictions=tuple(lines), on_rig=rig_verification, warnings=warnings)


Verifications = dict[str, tuple[Verification, DesignOptions]]
"""Verification and options of the specification of each axis, by the name of the axis."""


def add_simulation(configuration: Configuration, verifications: Verifications) -> Verifications:
    """Return the verifications with simulated steps of every stable axis; an unstable one stays unchanged.

    If no rig can represent the hardware, or the configuration cannot run on it, every axis gets a warning instead, and
    so does an axis whose simulation fails.
    """
    axes = {axis.name: axis for axis in configuration.axes}
    hardware_models = {name: _hardware_model(axes[name], design) for name, (_, design) in verifications.items()}
    try:
        bench = Bench(configuration, hardware_models)
    except (ValueError, RtloopError) as error:
        return {
            name: (_warn_unsimulated(verification, error), options)
            for name, (verification, options) in verifications.items()
        }
    return {
        name: (_simulate_axis(bench, axes[name], verification, options), options)
        if verification.running.is_stable
        else (verification, options)
        for name, (verification, options) in verifications.items()
    }


def _simulate_axis(bench: Bench, axis: AxisOptions, verification: Verification, design: DesignOptions) -> Verification:
    """Return a copy with the axis's simulated steps, or with a warning if `simulate` raises ValueError."""
    try:
        return replace(verification, simulated=simulate(bench, axis, verification.slowest_s, design))
    except ValueError as error:
        return _warn_unsimulated(verification, error)


def _warn_unsimulated(verification: Verification, error: Exception) -> Verification:
    """Return a copy with a warning that the steps are not simulated, because of `error`."""
    return replace(verification, warnings=(*verification.warnings, f"steps are not simulated: {error}"))


def _hardware_model(axis: AxisOptions, design: DesignOptions) -> HardwareModel:
    """Return the hardware of an axis: as `model` the axis's own, else its specification's, else None; sensor and
    residual hysteresis from the specification.
    """
    sensor, residual_percent = design.sensor, design.simulation.residual_percent
    model = axis.model or design.plant
    return HardwareModel(model, sensor.noise_um, sensor.resolution_um, sensor.bandwidth_hz, residual_percent)

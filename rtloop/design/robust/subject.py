"""Subject of a tap design, built from a configuration: the running loop, its drive and its specification."""

from __future__ import annotations

import math
from pathlib import Path

from rtloop.configuration.axis import AxisOptions, ModelOptions
from rtloop.configuration.checks import AxisCheck, Findings, check_axes, loop_delay_ticks
from rtloop.configuration.file import Configuration
from rtloop.configuration.rig import driver_delay_ticks
from rtloop.design.robust.programme import Bounds
from rtloop.design.robust.shape import Subject
from rtloop.design.synthesis.specification import DesignOptions, SpecificationOptions
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.errors import ConfigError
from rtloop.hysteresis.reach import reachable_range
from rtloop.laws.linearise import NOT_LINEAR
from rtloop.laws.shipped.options import PrandtlIshlinskiiOptions


def load_subject(configuration: Configuration, name: str, spec: Path | None) -> tuple[AxisOptions, Subject, Path]:
    """Load the axis `name`, its loop for the design of taps, and the path of its specification (`spec`, else the axis's
    own).

    Raises ConfigError for an unknown axis, an invalid configuration or specification, a missing specification, and an
    axis or specification that `build_subject` refuses; InputFileError for a specification that cannot be read.
    """
    axis = next((entry for entry in configuration.axes if entry.name == name), None)
    if axis is None:
        names = ", ".join(entry.name for entry in configuration.axes)
        fault = f"axis: {name!r} is unknown; allowed: {names}"
        raise ConfigError(configuration.source, [fault])
    findings = Findings()
    check = next(entry for entry in check_axes(configuration, findings) if entry.name == name)
    if findings.faults:
        raise ConfigError(configuration.source, findings.faults)
    if spec is None and axis.specification is not None:
        spec = configuration.folder / axis.specification
    if spec is None:
        raise ConfigError(configuration.source, [f"axis.{name}.specification: missing; use --spec FILE"])
    try:
        design = load_specification(spec).design
        return axis, build_subject(axis, check, design, driver_delay_ticks(configuration)), spec
    except ValueError as error:
        raise ConfigError(configuration.source, [f"axis.{name}: {error}"]) from None


def missing_requirements(specification: SpecificationOptions) -> list[str]:
    """Return the requirements for taps that the specification lacks or sets out of range, as text; [] if complete."""
    faults = []
    if specification.overshoot_percent is None or not 0 < specification.overshoot_percent <= 5:
        faults.append(
            "specification.overshoot_percent: "
            f"{'missing' if specification.overshoot_percent is None else specification.overshoot_percent}; "
            "allowed: above 0 and up to 5, because the band for settling is ±5 %"
        )
    if specification.command is None:
        faults.append(
            "specification.command.reference_um: missing; set the height of the reference's largest step in µm. The "
            "command stays within its limits in steps up to this height"
        )
    return faults


def build_subject(axis: AxisOptions, check: AxisCheck, design: DesignOptions, latency_ticks: int) -> Subject:
    """Build the loop of one axis for which taps are designed, with its bounds.

    The loop's delay in samples is the model's `delay_ticks` if the model states it, else `latency_ticks`, the driver's.
    Raises ValueError, naming the key, without a linear controller, a model or a requirement of `missing_requirements`,
    and for an axis with pre-filter sections, a slew limit or a reference that v cannot hold (`step_bounds`).
    """
    model, specification, options = axis.model or design.plant, design.specification, design.shape
    if check.linear is None:
        raise ValueError(
            f"controller: {_controller_fault(check)}; the taps of a pre-filter need a linear controller of one axis"
        )
    if model is None:
        raise ValueError("model: missing; set [axis.model], or [plant] in the specification")
    overshoot_percent, command, faults = (
        specification.overshoot_percent,
        specification.command,
        missing_requirements(specification),
    )
    if overshoot_percent is None or command is None or faults:
        raise ValueError(faults[0])
    if axis.prefilter.sections:
        raise ValueError("prefilter.sections: not allowed with taps; remove them")
    if axis.limits.slew_v_per_s is not None:
        raise ValueError("limits.slew_v_per_s: not allowed with taps, because a slew limit is not linear; remove it")
    return Subject(
        check.linear, design.sensor.add_sensor_lag(model.transfer()), loop_delay_ticks(model, latency_ticks),
        step_bounds(axis, model, design), overshoot_percent / 100, options,
    )  # fmt: skip


def step_bounds(axis: AxisOptions, model: ModelOptions, design: DesignOptions) -> Bounds:
    """Return the bounds of a step by `specification.command.reference_um`, and the levels between which steps lead.

    The levels lie on both sides of 0 if the range of v has equal sides, or if its shorter side has room for
    `command_um`. Otherwise they lie between 0 and the reference on the longer side, or in the middle of a range without
    0, as a drive of one sign has it. If the negative side is the longer one, all bounds and levels have their signs
    changed, because a loop and its mirror image have the same taps. Raises ValueError, naming the key, for a reference
    that v cannot hold, and without [specification.command].
    """
    command, undershoot = design.specification.command, design.shape.undershoot_percent / 100
    if command is None:
        raise ValueError(missing_requirements(design.specification)[0])
    step_um, (low_um, high_um) = command.reference_um, command_range_um(axis)
    static = 1 / abs(model.transfer().dc_gain)
    has_zero = low_um <= 0 <= high_um
    largest_um = max(-low_um, high_um) if has_zero else high_um - low_um
    if step_um * static > largest_um:
        limits = axis.limits
        raise ValueError(
            f"specification.command.reference_um: value is {step_um:g} µm; allowed: up to "
            f"{largest_um / static:.4g} µm, because the command has a range of {low_um:.4g} … {high_um:.4g} µm "
            f"(limits.drive_min_v = {limits.lowest_v:g}, limits.drive_v = {limits.drive_v:g}, limits.command_um = "
            f"{limits.command_um:g}). Set a smaller reference_um; smaller steps can also settle faster"
        )
    has_equal_sides = math.isclose(-low_um, high_um, rel_tol=1e-6) and step_um * static <= -low_um
    if has_equal_sides or max(command.command_um, step_um * static) <= min(-low_um, high_um):
        return Bounds(undershoot, step_um, -step_um, low_um, high_um)
    if -low_um > high_um:  # a loop and its mirror image have the same taps
        low_um, high_um = -high_um, -low_um
    lowest_um = 0.0 if has_zero else (low_um + high_um) / (2 * static) - step_um / 2
    return Bounds(undershoot, step_um, lowest_um, low_um, high_um)


def _controller_fault(check: AxisCheck) -> str:
    """Return the reason why a controller cannot be linearised for one axis: shared, missing or not linear."""
    if check.together is not None:
        return f"shared by the axes {', '.join(check.together.axes)}"
    return "missing" if check.law is None else f"the law {NOT_LINEAR}"


def command_range_um(axis: AxisOptions) -> tuple[float, float]:
    """Return least and largest static command v in µm that the drive can hold whatever came before, within the axis's
    ±`limits.command_um`.

    For other feedforward than a play model, they are ±`limits.command_um`; the least is 0 where the drive cannot be
    negative.
    """
    limits, law = axis.limits, axis.feedforward
    limit_um = limits.command_um
    if not isinstance(law, PrandtlIshlinskiiOptions):
        return (-limit_um if limits.lowest_v < 0 else 0.0), limit_um
    return reachable_range(law.models()[0], limits.lowest_v, limits.drive_v, limit_um)

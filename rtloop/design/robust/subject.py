"""Subject of a tap design, built from a configuration: the running loop, its drive and its specification."""

from __future__ import annotations

from pathlib import Path

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.checks import AxisCheck, Findings, check_axes, loop_delay_ticks
from rtloop.configuration.file import Configuration
from rtloop.configuration.rig import rig_delay_ticks
from rtloop.design.robust.programme import Bounds
from rtloop.design.robust.shape import Subject
from rtloop.design.synthesis.specification import DesignOptions, SpecificationOptions
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.errors import ConfigError
from rtloop.hysteresis.plays import loading_curve
from rtloop.laws.linearise import NOT_LINEAR
from rtloop.laws.shipped.options import PrandtlIshlinskiiOptions


def load_subject(configuration: Configuration, name: str, spec: Path | None) -> tuple[AxisOptions, Subject, Path]:
    """Load the axis `name`, its loop for the design of taps, and the path of its specification (`spec`, else the axis's
    own).

    Raises ConfigError for an unknown axis, an invalid configuration or specification and a missing requirement;
    InputFileError for a specification that cannot be read.
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
        return axis, build_subject(axis, check, design, rig_delay_ticks(configuration)), spec
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
            "specification.command.reference_um: missing; set the largest step of the reference, at which v must stay "
            "within its limits"
        )
    return faults


def build_subject(axis: AxisOptions, check: AxisCheck, design: DesignOptions, latency_ticks: int) -> Subject:
    """Build the loop of one axis for which taps are designed, with its bounds.

    Its delay is the model's if the model states one, else the rig's `latency_ticks`, in samples.
    Raises ValueError, naming the key, without a linear controller, a model or a requirement of `missing_requirements`,
    and for an axis with pre-filter sections or a slew limit.
    """
    model, specification, options = axis.model or design.plant, design.specification, design.shape
    if check.linear is None:
        raise ValueError(f"controller: {_controller_fault(check)}; taps need a linear controller of one axis")
    if model is None:
        raise ValueError("model: missing; set it, or [plant] in the specification")
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
    low_um, high_um = command_range_um(axis)
    step_um = command.reference_um
    bounds = Bounds(options.undershoot_percent / 100, step_um, -step_um if low_um < 0 else 0.0, low_um, high_um)
    return Subject(
        check.linear, design.sensor.add_sensor_lag(model.transfer()), loop_delay_ticks(model, latency_ticks), bounds,
        overshoot_percent / 100, options,
    )  # fmt: skip


def _controller_fault(check: AxisCheck) -> str:
    """Return the reason why a controller cannot be linearised for one axis: shared, missing or not linear."""
    if check.together is not None:
        return f"shared by the axes {', '.join(check.together.axes)}"
    return "missing" if check.law is None else f"it {NOT_LINEAR}"


def command_range_um(axis: AxisOptions) -> tuple[float, float]:
    """Return least and largest v in µm: the drive's limits on the initial loading curve, within ±`command_um`.

    For other feedforward than a play model, ±`command_um`. The least is 0 where the drive cannot be negative.
    """
    limits, law = axis.limits, axis.feedforward
    limit_um = limits.command_um
    if not isinstance(law, PrandtlIshlinskiiOptions):
        return (-limit_um if limits.lowest_v < 0 else 0.0), limit_um
    model, _ = law.models()
    high, low = (float(loading_curve(model, volts)) for volts in (limits.drive_v, -limits.lowest_v))
    return -min(low, limit_um), min(high, limit_um)

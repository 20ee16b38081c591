"""Design in one call: from an identified stage to a damping controller with taps, and their configuration.

    stage ──► C(z) over [scenarios] ──► taps over [shape.scenarios] ──► configuration

Values in the specification are met or refused. Unset ones start at the best and are relaxed to suit the stage:
resonance range of C(z) and of the taps, number of taps, bandwidth of disturbance rejection.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtloop.analysis.closed_loop import discrete_loop
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.checks import Findings, check_axes
from rtloop.configuration.file import Configuration, parse
from rtloop.configuration.rig import driver_delay_ticks
from rtloop.design.chain import Stage, stage_configuration
from rtloop.design.identification.hysteresis.creep import describe_unexplained, is_creep_likely
from rtloop.design.identification.hysteresis.identify_hysteresis import unexplained_um
from rtloop.design.robust.options import MOST_TAPS, ShapeOptions
from rtloop.design.robust.scenarios import Family
from rtloop.design.robust.search import (
    MISSING_DISTURBANCE_FREQUENCY,
    Progress,
    RobustDesign,
    find_robust_controller,
)
from rtloop.design.robust.section import provenance, robust_values, taps_provenance, taps_values
from rtloop.design.robust.shape import Subject, TapDesign, design_taps
from rtloop.design.robust.subject import build_subject, missing_requirements, step_bounds
from rtloop.design.synthesis.hinf.assumptions import NoController
from rtloop.design.synthesis.specification import DesignOptions, DisturbanceOptions
from rtloop.errors import ConfigError, NoDesign
from rtloop.linear.discretise import discretise_controller

RANGES_PERCENT = (10.0, 5.0, 2.0)
"""Resonance ranges (±%) tried for the controller if the specification has no [scenarios]."""
TAPS_RANGES_PERCENT = (5.0, 2.0, 1.0, 0.0)
"""Resonance ranges (±%) tried for the taps if the specification has no [shape.scenarios]."""
TAPS_GAIN_PERCENT = 1.5
"""Range of the gain (±%) tried first for the taps, with the widest range of the resonance: the slope that an identified
hysteresis misses.
"""
TAP_PERIODS = 2.9
"""Default length of the taps, in periods of the slowest leading mode."""
NARROW_PERCENT = 2.5
"""Default settling band, half of ±5 %: residual hysteresis and noise may take the other half."""
LEAST_DAMPING, FREQUENCY_FACTOR = 0.1, 1.5
"""Least closed-loop damping of modes between the lowest leading frequency divided by FREQUENCY_FACTOR and the highest
multiplied by it. Taps shape steps of the model; any other excitation leaves modes ringing.
"""
FEWEST_POINTS = 3
"""Fewest points per tick in a programme of many taps; the proof always uses PROOF_POINTS."""
HELD_SENSITIVITY, DISTURBANCE_RATIO = 0.1, 100.0
"""Default disturbance: |S| = HELD_SENSITIVITY up to the slowest leading mode's frequency divided by
DISTURBANCE_RATIO.
"""


class NoTaps(NoDesign):
    """No taps suit the controller that was found; `text` is the configuration with the controller alone."""

    def __init__(self, message: str, text: str) -> None:
        """Store `text`, the configuration with the controller alone; `message` says why there are no taps."""
        super().__init__(message)
        self.text = text


class RobustChain(NamedTuple):
    """Results of all design steps; `design` and `subject` are those used for the final result."""

    stage: Stage
    design: DesignOptions
    robust: RobustDesign
    subject: Subject
    taps: TapDesign


def design_robust_loop(
    stage: Stage, design: DesignOptions, axis: str | None, folder: Path, spec_name: str, spec_text: str,
    progress: Progress = lambda _: None,
) -> tuple[RobustChain, str]:  # fmt: skip
    """Design a controller and its taps; return the results of all steps, and the step recording's configuration as TOML
    with the design in its axis `axis` (None: the first), which must exist.

    `spec_name` is the specification's path relative to `folder`, the configuration's folder. `design` has passed
    `require_specified`. `progress` receives a sentence after each attempt. Raises NoDesign with the missed requirement,
    NoTaps if only the taps are missing, UnsuitableData for hysteresis weights without an inverse.
    """
    _require_play_model(stage, design)
    final_design = stage.complete_design(design)
    _require_reachable_steps(stage, final_design, axis, folder, spec_name)
    final_design, controller = _find_controller(final_design, progress)
    comments = provenance(controller, final_design, spec_name, spec_text)
    parts = {"controller": robust_values(controller, final_design)}
    plain_text = stage_configuration(stage, parts, comments, axis, spec_name)
    configuration, findings = parse(plain_text, "designed", folder, spec_name), Findings()
    checks = check_axes(configuration, findings)
    axis_options = _selected_axis(configuration, axis)
    check = next(entry for entry in checks if entry.name == axis_options.name)
    try:
        tap_design = _choose_tap_options(final_design, controller.family)
        subject = build_subject(axis_options, check, tap_design, driver_delay_ticks(configuration))
    except ValueError as error:
        raise NoDesign(f"axis.{axis_options.name}.{error}") from None
    subject = _limit_command(subject, final_design)
    try:
        subject, taps = _find_taps(subject, design, progress)
    except NoDesign as error:
        comments += [
            "No taps were found for this controller, so that steps of the reference are not shaped:",
            str(error),
        ]
        raise NoTaps(str(error), stage_configuration(stage, parts, comments, axis, spec_name)) from None
    comments += taps_provenance(taps, subject, spec_name)
    text = stage_configuration(stage, {**parts, "prefilter": taps_values(taps.taps)}, comments, axis, spec_name)
    return RobustChain(stage, final_design, controller, subject, taps), text


def require_specified(design: DesignOptions, source: str) -> None:
    """Raise ConfigError, with all missing entries, for an incomplete specification: a check before the long
    computation. `source` names the specification's file.
    """
    specification = design.specification
    faults = missing_requirements(specification)
    if specification.disturbance is not None and specification.disturbance.up_to_hz is None:
        faults.append(MISSING_DISTURBANCE_FREQUENCY)
    if faults:
        raise ConfigError(source, faults)


def _selected_axis(configuration: Configuration, axis: str | None) -> AxisOptions:
    """Return the options of the axis named `axis` (None: the first), which must exist."""
    return next(entry for entry in configuration.axes if axis in (None, entry.name))


def _require_reachable_steps(
    stage: Stage, design: DesignOptions, axis: str | None, folder: Path, spec_name: str
) -> None:
    """Raise NoDesign if the stage's drive cannot hold the specification's reference step; without plant, do nothing.

    `axis` None is the first axis; relative paths of the configuration begin at `folder`.
    """
    configuration = parse(stage_configuration(stage, {}, [], axis, spec_name), "identified", folder, spec_name)
    axis_options = _selected_axis(configuration, axis)
    if design.plant is None:
        return
    try:
        step_bounds(axis_options, design.plant, design)
    except ValueError as error:
        raise NoDesign(str(error)) from None


def _require_play_model(stage: Stage, design: DesignOptions) -> None:
    """Raise NoDesign if no sum of plays describes the actuator (`unexplained_um`), so that steps cannot be predicted.

    With `simulation.residual_percent` in the specification, it does not raise: that much hysteresis is simulated.
    """
    left_um = unexplained_um([stage.slow], stage.hysteresis)
    if left_um and "residual_percent" not in design.simulation.model_fields_set:
        raise NoDesign(
            f"{stage.slow.name}: {describe_unexplained(left_um, is_creep_likely(stage.slow))}. Set "
            "simulation.residual_percent to the hysteresis (% of the position's range) that remains with the "
            "feedforward; `rtloop experiment run compensation` measures this number. The design then continues, and is "
            "verified with this hysteresis"
        )


def _find_controller(design: DesignOptions, progress: Progress) -> tuple[DesignOptions, RobustDesign]:
    """Return the design with the widest resonance range that has a controller, and that controller.

    Raises NoDesign if no range has one, and for a plant or specification that `find_robust_controller` refuses.
    """
    design = _add_disturbance(design)
    *wider, last = _candidate_designs(design)
    for narrowed in wider:
        try:
            return narrowed, _find_damped_controller(narrowed, progress)
        except NoController as error:
            progress(
                f"no controller was found for resonances within ±{narrowed.scenarios.resonance_percent:g} % of the "
                f"model's: {error}"
            )
        except ValueError as error:  # a narrower range has the same plant and specification
            raise NoDesign(str(error)) from None
    try:
        return last, _find_damped_controller(last, progress)
    except (NoController, ValueError) as error:
        percent = last.scenarios.resonance_percent
        prefix = f"no controller was found even for resonances within ±{percent:g} % of the model's: " if wider else ""
        raise NoDesign(f"{prefix}{error}") from None


def _find_damped_controller(design: DesignOptions, progress: Progress) -> RobustDesign:
    """Find a controller that damps the modes near the leading ones, or that meets `robust.decay_ms` if it is set.

    Raises NoController if the search finds none or the damping stays below LEAST_DAMPING.
    """
    robust = find_robust_controller(design, progress)
    if design.robust.decay_ms is None and robust.family.leading:
        hz, damping = _least_damped_mode(robust)
        if damping < LEAST_DAMPING:
            raise NoController(
                f"robust: the closed loop's mode at {hz:.4g} Hz has a damping ratio of {damping:.2g}; allowed: "
                f"at least {LEAST_DAMPING:g}, because residual hysteresis excites this mode in every step. Use another "
                "kind of controller, or accept a longer decay with robust.decay_ms"
            )
    return robust


def _least_damped_mode(robust: RobustDesign) -> tuple[float, float]:
    """Return frequency |s|/2π (Hz) and damping ratio of the least damped closed-loop mode of the model near its leading
    modes (FREQUENCY_FACTOR); without a mode there, the damping is 1, and the frequency has no meaning.
    """
    family = robust.family
    controller = discretise_controller(robust.controller, family.period_s, "matched")
    rates = discrete_loop(controller, family.plant(family.nominal), family.nominal.delay_ticks).rates
    sizes, leading = np.abs(rates), np.abs(family.modes[list(family.leading)])
    nearby = rates[(sizes > leading.min() / FREQUENCY_FACTOR) & (sizes < leading.max() * FREQUENCY_FACTOR)]
    least_damped = min(nearby, key=lambda rate: -rate.real / abs(rate), default=complex(-1.0))
    return abs(least_damped) / (2 * math.pi), float(-least_damped.real / abs(least_damped))


def _candidate_designs(design: DesignOptions) -> Iterator[DesignOptions]:
    """Yield `design` alone if it has [scenarios]; otherwise yield a copy of it for each resonance range in
    RANGES_PERCENT, widest first.
    """
    if "scenarios" in design.model_fields_set:
        yield design
        return
    for percent in RANGES_PERCENT:
        scenarios = design.scenarios.model_copy(update={"resonance_percent": percent})
        yield design.model_copy(update={"scenarios": scenarios})


def _add_disturbance(design: DesignOptions) -> DesignOptions:
    """Return `design`, with the default disturbance if it has none: without one, the slowest integrator would suffice.

    A design without a plant is returned unchanged.
    """
    specification = design.specification
    if specification.disturbance is not None or design.plant is None:
        return design
    period_s = 1 / design.controller.rate_hz
    family = Family(design.plant.transfer(), design.plant.delay_ticks, design.scenarios, period_s)
    slowest_hz = _slowest_hz(family)
    disturbance = DisturbanceOptions(largest_um=1.0, error_um=HELD_SENSITIVITY, up_to_hz=slowest_hz / DISTURBANCE_RATIO)
    return design.model_copy(update={"specification": specification.model_copy(update={"disturbance": disturbance})})


def _choose_tap_options(design: DesignOptions, family: Family) -> DesignOptions:
    """Return `design` with unset options of [shape] set: enough `taps` for the slowest leading mode, `points_per_tick`
    for about as many points in total as the default taps have, and a `band_percent` for settling of NARROW_PERCENT,
    which leaves room for nonlinear effects.
    """
    shape: ShapeOptions = design.shape
    needed_taps = math.ceil(TAP_PERIODS / (_slowest_hz(family) * family.period_s))
    taps = min(max(needed_taps, shape.taps), MOST_TAPS)
    points = max(FEWEST_POINTS, shape.points_per_tick * shape.taps // taps)
    defaults = {"taps": taps, "points_per_tick": points, "band_percent": NARROW_PERCENT}
    unset = {name: value for name, value in defaults.items() if name not in shape.model_fields_set}
    return design.model_copy(update={"shape": shape.model_copy(update=unset)})


def _slowest_hz(family: Family) -> float:
    """Return the lowest frequency of a leading mode in Hz, at most a tenth of the rate; that tenth without a mode."""
    leading = np.abs(family.modes[list(family.leading)]) / (2 * np.pi)
    return float(np.min(leading, initial=0.1 / family.period_s))


def _limit_command(subject: Subject, design: DesignOptions) -> Subject:
    """Return `subject` with |v| limited to `command_um` of [specification.command] too; unchanged unless `command_um`
    is larger than `reference_um`.
    """
    command, bounds = design.specification.command, subject.bounds
    if command is None or command.command_um <= command.reference_um:
        return subject
    limited = bounds._replace(
        low_um=max(bounds.low_um, -command.command_um), high_um=min(bounds.high_um, command.command_um)
    )
    return replace(subject, bounds=limited)


def _find_taps(subject: Subject, design: DesignOptions, progress: Progress) -> tuple[Subject, TapDesign]:
    """Return the subject with the widest ranges of resonance and gain that has taps, and the taps: TAPS_GAIN_PERCENT if
    they settle within `specification.settling_ms`, then TAPS_RANGES_PERCENT. Only the subject's own ranges are tried if
    [shape.scenarios] states them.

    Raises NoDesign if the last ranges have no taps either.
    """
    if "scenarios" in design.shape.model_fields_set:
        return subject, design_taps(subject, progress=progress)
    settling_ms = design.specification.settling_ms or math.inf
    narrower = [subject.restrict_resonance(percent) for percent in TAPS_RANGES_PERCENT]
    *wider, last = [subject.restrict_resonance(TAPS_RANGES_PERCENT[0], TAPS_GAIN_PERCENT), *narrower]
    for candidate in wider:
        scenarios = candidate.options.scenarios
        try:
            taps = design_taps(candidate, progress=progress)
            if not scenarios.gain_percent or taps.settling_ms <= settling_ms:
                return candidate, taps
            cause = f"they settle in {taps.settling_ms:.4g} ms; specification.settling_ms is {settling_ms:g} ms"
        except NoDesign as error:
            cause = str(error)
        progress(
            f"no usable taps for resonances within ±{scenarios.resonance_percent:g} % and gains within "
            f"±{scenarios.gain_percent:g} % of the model's: {cause}"
        )
    return last, design_taps(last, progress=progress)

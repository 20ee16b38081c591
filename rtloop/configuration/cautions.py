"""Warnings about a configuration that can run: key, value and the allowed range, a line each.

`option_cautions` judges options, references and the loop on the simulated rig, at every start of a loop. `cautions`
adds the accuracy of C(z) and the margins of the loop.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator

import numpy as np

from rtloop.analysis.step_response import SETTLING_BAND
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.certain_trips import certain_trips
from rtloop.configuration.checks import AxisCheck
from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared, build_driver
from rtloop.configuration.reference_options import StepsOptions
from rtloop.configuration.references import extent, played_samples, references_in_plan, volts
from rtloop.configuration.rig import driver_delay_ticks
from rtloop.configuration.simulated import (
    RigComparison,
    compare_with_rig,
    delay_difference,
    drive_ends_um,
    sensor_ends_um,
)
from rtloop.engine.plan import Plan
from rtloop.hysteresis.reach import can_hold, reachable_range
from rtloop.signals import Mode

HIGHEST_MEASURED_HZ = 100_000
"""Highest rate that a loop was measured to keep, whether it sleeps or spins until its ticks."""


def cautions(prepared: Prepared) -> list[str]:
    """Return all warnings, a line each: of `option_cautions`, of C(z) against C(s), and of the loops' margins."""
    warnings = option_cautions(prepared)
    for axis, check in zip(prepared.configuration.axes, prepared.checks, strict=True):
        warnings += [*comparison_warnings(check), *(f"axis.{axis.name}.{line}" for line in _margins(axis, check))]
    return warnings


def option_cautions(prepared: Prepared) -> list[str]:
    """Return warnings, a line each, about options, references, contradictions between axis and hardware, and loops that
    are unstable on the simulated rig or, where axis and rig contradict each other, do not follow their reference on it.
    No margin is computed.
    """
    configuration = prepared.configuration
    warnings = [f"loop.{line}" for line in _pacing(configuration)] + list(_service(configuration))
    warnings += build_driver(configuration).cautions()
    warnings += _first_step(prepared)
    for axis, check in zip(configuration.axes, prepared.checks, strict=True):
        lines = (
            *reference_cautions(configuration, prepared.plan, axis),
            *_certain_trips(prepared, axis, check),
            *_reach(configuration, axis),
        )
        warnings += [f"axis.{axis.name}.{line}" for line in lines]
        comparison = compare_with_rig(configuration, axis, check)
        warnings += [*_delay(configuration, axis, check), *comparison.contradictions]
        if (problem := rig_problem(axis, check, comparison)) is not None:
            warnings.append(problem)
    return warnings


def comparison_warnings(check: AxisCheck) -> list[str]:
    """Return a warning for each notch or resonance of C(s) that C(z) lacks or shifts too far; [] without a C(s)."""
    if check.comparison is None:
        return []
    return [f"axis.{check.name}.controller: {warning}" for warning in check.comparison.warnings]


def _pacing(configuration: Configuration) -> Iterator[str]:
    """Yield a warning for a processor that this machine does not have, and for a rate that no measured machine kept."""
    cpu, processors = configuration.loop.cpu, os.cpu_count() or 1
    if cpu is not None and cpu >= processors:
        yield f"cpu: {cpu}; this machine has processors 0 to {processors - 1}. The loop would run on any of them"
    if configuration.loop.rate_hz > HIGHEST_MEASURED_HZ:
        yield (
            f"rate_hz: {configuration.loop.rate_hz:g} Hz; the highest rate that a measured machine kept with paced "
            f"ticks is {HIGHEST_MEASURED_HZ:g} Hz (docs/benchmarks.md)"
        )


def _service(configuration: Configuration) -> Iterator[str]:
    """Yield a warning for each [service] option that `rtloop serve` refuses with a schedule, or ignores with `arm`."""
    options = configuration.service
    if configuration.schedule:
        yield from (f"{fault}; `rtloop serve` refuses this configuration" for fault in options.faults_with_schedule())
    elif options.arm and options.prepares:
        yield "service.depolarise, service.tare_s: no effect with service.arm = true"


def _margins(axis: AxisOptions, check: AxisCheck) -> Iterator[str]:
    """Yield a warning if a stable loop does not follow its reference, and one for each of its margins that
    [axis.margins] does not allow; none for an unstable or unknown loop.
    """
    margins, options = check.margins, axis.margins
    if margins is None or check.on_model is None or not check.on_model.is_stable:
        return  # an unstable loop has no margins, and `check_axes` has reported it
    if (problem := tracking_problem(check)) is not None:
        yield f"controller: {problem}"
    if margins.gain_margin < options.gain:
        yield f"controller: gain margin {margins.gain_margin:.3g}, below margins.gain = {options.gain:g}"
    if margins.phase_margin_deg < options.phase_deg:
        phase_deg = margins.phase_margin_deg
        yield f"controller: phase margin {phase_deg:.3g}°, below margins.phase_deg = {options.phase_deg:g}"
    if margins.max_sensitivity > options.sensitivity:
        yield f"controller: max |S| {margins.max_sensitivity:.3g}, above margins.sensitivity = {options.sensitivity:g}"


def tracking_problem(check: AxisCheck) -> str | None:
    """Return a text if a stable loop does not follow its reference at rest, to the fraction SETTLING_BAND of a step.

    None if the loop follows, is unstable or is not known, and for a law that is not linear in its reference.
    """
    if check.on_model is None or not check.on_model.is_stable or check.on_model.reference_fault:
        return None
    final_um, _ = check.on_model.final_values
    if abs(1 - final_um) <= SETTLING_BAND:
        return None
    outcome = f"a step of 1 µm ends at {final_um:.3g} µm"
    if final_um < 0 or final_um > 1:
        return f"{outcome}: the loop's gain at 0 Hz has the wrong sign"
    return f"{outcome}: the loop does not follow its reference"


def rig_problem(axis: AxisOptions, check: AxisCheck, comparison: RigComparison) -> str | None:
    """Return a text if the loop of an axis is unstable on the simulated rig, or does not follow its reference there.

    None if it is stable and follows, and if `comparison` has no check on the rig.
    """
    lines, on_rig = comparison
    if on_rig is None or on_rig.on_model is None:
        return None
    problem = tracking_problem(on_rig)
    if not on_rig.on_model.is_stable:
        is_stable_on_model = check.on_model is not None and check.on_model.is_stable
        is_unexplained = is_stable_on_model and not lines
        cause = f": the rig's plant or weights differ from those of axis.{axis.name}" if is_unexplained else ""
        problem = f"the loop is unstable (largest |pole| {np.abs(on_rig.on_model.poles).max():.6f}){cause}"
    return None if problem is None else f"axis.{axis.name}: on the simulated rig, {problem}"


def _first_step(prepared: Prepared) -> Iterator[str]:
    """Yield a warning for a run that ends before the first of its references steps; none where a reference is no series
    of steps.
    """
    configuration, ticks = prepared.configuration, prepared.plan.ticks
    references = [axis.reference for axis in configuration.axes]
    steps = [reference for reference in references if isinstance(reference, StepsOptions)]
    if ticks is None or len(steps) < len(references) or configuration.schedule:
        return
    rate_hz = configuration.loop.rate_hz
    first_s = min(round(reference.dwell_s * rate_hz) for reference in steps) / rate_hz
    if ticks / rate_hz <= first_s and any(len(set(reference.levels)) > 1 for reference in steps):
        yield (
            f"axis.reference.dwell_s: the first step comes after {first_s:g} s, and this run ends after "
            f"{ticks / rate_hz:g} s: it has no step. Use --duration with at least {2 * first_s:g}"
        )


def reference_cautions(configuration: Configuration, plan: Plan, axis: AxisOptions) -> Iterator[str]:
    """Yield lines for each reference of the axis, its own and the schedule's, that is beyond the axis's limits.

    Each reference is judged in the mode in which it begins.
    """
    limits = axis.limits
    for label, mode, values in references_in_plan(plan, plan.axes.index(axis.name)):
        samples, command_um = played_samples(plan, values)
        lowest, highest = extent(values, samples)
        if mode == Mode.RAW and not limits.lowest_v <= lowest <= highest <= limits.drive_v:
            allowed = f"{limits.lowest_v:g} V … {limits.drive_v:g} V"
            yield f"{label}: {volts(lowest, highest)}, beyond the drive's limits, {allowed}"
        if mode in (Mode.FEEDFORWARD, Mode.CLOSED_LOOP):
            ends_um = sensor_ends_um(configuration, axis)
            yield from (f"{label}: {line}" for line in _unreachable(axis, lowest, highest, ends_um))
        if (largest_um := float(np.max(np.abs(command_um), initial=0.0))) > limits.command_um:
            yield f"{label}: adds {largest_um:g} µm to the command, beyond limits.command_um = {limits.command_um:g}"


def _certain_trips(prepared: Prepared, axis: AxisOptions, check: AxisCheck) -> Iterator[str]:
    """Yield a line for each interlock that a reference of the axis in closed loop, its own or the schedule's, trips."""
    plan, rate_hz = prepared.plan, prepared.configuration.loop.rate_hz
    for label, mode, values in references_in_plan(plan, plan.axes.index(axis.name)):
        if mode == Mode.CLOSED_LOOP:
            samples, _ = played_samples(plan, values)
            trips = certain_trips(axis, check, values, samples, rate_hz, is_first=label == "reference")
            yield from (f"{label}: {line}" for line in trips)


def _unreachable(axis: AxisOptions, lowest_um: float, highest_um: float, ends_um: tuple[float, float]) -> Iterator[str]:
    """Yield a line for each limit (position interlock, sensor, drive) that a reference `lowest_um` … `highest_um`
    exceeds.

    A reference beyond the command's limit gets that line alone. `ends_um` are the ends of the sensor's range.
    """
    limits, position_um = axis.limits, axis.interlocks.position_um
    farthest_um = max(-lowest_um, highest_um)
    if farthest_um > limits.command_um:
        yield f"reaches {farthest_um:g} µm, beyond limits.command_um = {limits.command_um:g}"
        return
    if farthest_um > position_um:
        yield f"reaches {farthest_um:g} µm, beyond interlocks.position_um = {position_um:g}; the loop would trip"
    for reached_um, end_um, is_beyond in (
        (lowest_um, ends_um[0], lowest_um < ends_um[0]),
        (highest_um, ends_um[1], highest_um > ends_um[1]),
    ):
        if is_beyond:
            yield (
                f"reaches {reached_um:g} µm, beyond the end of the sensor's range, {end_um:.4g} µm; the loop would trip"
            )
    yield from _beyond_drive(axis, lowest_um, highest_um)


def _beyond_drive(axis: AxisOptions, lowest_um: float, highest_um: float) -> Iterator[str]:
    """Yield one line if the drive's limits do not allow a reference from `lowest_um` to `highest_um`, else none.

    The feedforward's model goes from rest to the end on the side where the drive reaches farther, or to the farther end
    where it reaches equally far; then, with the hysteresis of that motion, to the other end. The line states the
    positions that the limits allow.
    """
    limits, actuator = axis.limits, axis.feedforward.actuator()
    ends_v = limits.lowest_v, limits.drive_v
    down_um, up_um = drive_ends_um(axis)
    is_even = math.isclose(-down_um, up_um)
    first = abs if is_even else lambda end_um: end_um * (down_um + up_um)
    positions_um = sorted((lowest_um, highest_um), key=first, reverse=True)
    if can_hold(actuator, positions_um, *ends_v):
        return
    is_virgin = lowest_um == highest_um
    low_um, high_um = (down_um, up_um) if is_virgin else reachable_range(actuator, *ends_v, abs(positions_um[0]))
    is_upward = down_um + up_um > 0
    if not is_virgin and not is_even:  # the farther end itself does not limit the other direction
        low_um, high_um = (low_um, up_um) if is_upward else (down_um, high_um)
    is_within_ends = down_um <= lowest_um <= highest_um <= up_um
    memory = f" after a motion to {positions_um[0]:g} µm, because of the hysteresis" if is_within_ends else ""
    yield (
        f"{lowest_um:g} … {highest_um:g} µm; the drive's limits, {limits.lowest_v:g} V … {limits.drive_v:g} V, "
        f"allow only {low_um:.4g} … {high_um:.4g} µm{memory}"
    )


def _reach(configuration: Configuration, axis: AxisOptions) -> Iterator[str]:
    """Yield a warning if limits.command_um lies beyond the range of the drive, and one if interlocks.position_um lies
    beyond the range of the sensor: such a limit never acts.
    """
    limits, interlocks = axis.limits, axis.interlocks
    reach_um = max(np.abs(drive_ends_um(axis)))
    if limits.command_um > reach_um:
        yield f"limits.command_um: {limits.command_um:g} µm never acts; the drive's limits allow only {reach_um:.4g} µm"
    if interlocks.position_um > (sensor_um := max(map(abs, sensor_ends_um(configuration, axis)))):
        yield (
            f"interlocks.position_um: {interlocks.position_um:g} µm never trips; the sensor's range ends at "
            f"{sensor_um:.4g} µm"
        )


def _delay(configuration: Configuration, axis: AxisOptions, check: AxisCheck) -> Iterator[str]:
    """Yield a warning for a model that states no delay if rig or driver has one: the loop is judged with the latter."""
    if axis.model is not None and axis.model.delay_ticks < driver_delay_ticks(configuration) <= check.delay_ticks:
        yield delay_difference(configuration, axis, axis.model.delay_ticks, check)

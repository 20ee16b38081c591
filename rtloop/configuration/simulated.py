"""Contradictions between the configuration of an axis and its hardware, and the loop that the simulated rig closes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.checks import AxisCheck
from rtloop.configuration.file import Configuration
from rtloop.configuration.rig import driver_delay_ticks, plant_dynamics, plant_plays, simulated_plant
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import loading_curve
from rtloop.hysteresis.reach import PositionRange, reachable_range
from rtloop.linear.transfer import Transfer

LARGEST_STROKE_RATIO = 3.0
"""Strokes that differ by more than this factor belong to different actuators."""
SAME_SCALE = 0.01
"""Relative difference up to which two scales of a sensor are the same."""
COMPARED = np.linspace(0.1, 0.5, 9)
"""Frequencies at which delays of plants are compared, relative to the lower of the lowest mode and a tenth of the rate.
"""


class RigComparison(NamedTuple):
    """Contradictions between an axis and its hardware, a line each, and the axis on the simulated rig.

    `on_rig` is None for an axis without contradiction whose loop is stable on the rig, for other drivers, and where no
    linear loop is known.
    """

    contradictions: list[str]
    on_rig: AxisCheck | None


def compare_with_rig(configuration: Configuration, axis: AxisOptions, check: AxisCheck) -> RigComparison:
    """Return the contradictions of an axis, and its check on the simulated rig if there are contradictions or the loop
    is unstable on the rig.

    A contradiction means that another loop than the checked one would run: by the weights against the simulated
    actuator and the sensor's range, `um_per_v` against the simulated sensor, the delay against rig or driver.
    """
    on_rig = _check_on_rig(configuration, axis, check)
    lines = [
        *_weights(configuration, axis),
        *_sensor_scale(configuration, axis),
        *_delay(configuration, axis, check, on_rig),
    ]
    if not lines and on_rig is not None and on_rig.on_model is not None and on_rig.on_model.is_stable:
        on_rig = None
    return RigComparison(lines, on_rig)


def _check_on_rig(configuration: Configuration, axis: AxisOptions, check: AxisCheck) -> AxisCheck | None:
    """Return the check of the axis on the dynamics, stroke, sensor and delay of the simulated rig instead of its model.

    A longer delay of the model is kept. None for other drivers, and where no linear loop is known.
    """
    plant = simulated_plant(configuration, axis.name)
    if plant is None or check.on_model is None:
        return None
    gain = (
        configuration.channels[axis.name].um_per_v
        / plant.sensor.um_per_v
        * (_stroke_ratio(axis, plant_plays(plant)) or 1.0)
    )
    dynamics = plant_dynamics(plant.dynamics) * Transfer.from_zpk([], [], gain)
    if plant.sensor.bandwidth_hz is not None:
        rate = 2 * math.pi * plant.sensor.bandwidth_hz
        dynamics = dynamics * Transfer.from_zpk([], [-rate], rate)
    delay = max(check.delay_ticks, driver_delay_ticks(configuration))
    try:
        loop = check.loop(dynamics, delay)
    except ValueError:
        return None
    return replace(check, plant=dynamics, delay_ticks=delay, on_model=loop)


def drive_ends_um(axis: AxisOptions) -> tuple[float, float]:
    """Return the positions in µm at the drive's lower and upper limit, from rest, by the feedforward's model.

    With weights above 0, the first is ≤ 0 and the second ≥ 0. (0, 0) without plays.
    """
    ends_v = np.array([axis.limits.lowest_v, axis.limits.drive_v])
    down_um, up_um = np.sign(ends_v) * loading_curve(axis.feedforward.actuator(), np.abs(ends_v))
    return float(down_um), float(up_um)


def sensor_ends_um(
    configuration: Configuration, axis: AxisOptions, offset_v: float | None = None
) -> tuple[float, float]:
    """Return the lowest and the highest position in µm that the sensor shows within its interlocks.

    `offset_v` is the reading at position 0 of a tared axis; None: the configured one.
    """
    channel, interlocks = configuration.channels[axis.name], axis.interlocks
    ends_v = np.array([interlocks.sensor_min_v, interlocks.sensor_max_v])
    low_um, high_um = sorted((ends_v - (channel.offset if offset_v is None else offset_v)) * channel.um_per_v)
    return float(low_um), float(high_um)


def sensor_reach_um(configuration: Configuration, axis: AxisOptions) -> float:
    """Return the largest |position| in µm to which a motion about 0 may reach within the sensor's interlocks.

    The nearer end counts where the drive goes to both sides, else the farther one.
    """
    low_um, high_um = sensor_ends_um(configuration, axis)
    return max(min(-low_um, high_um), 0.0) if axis.limits.lowest_v < 0.0 else max(-low_um, high_um)


def one_sided_range(axis: AxisOptions, sensor_ends_um: tuple[float, float]) -> PositionRange:
    """Return the slow commands in µm that can follow each other in any order, for a drive of one sign.

    They are within the limits of command and drive, and trip neither the position interlock nor the sensor's.
    """
    actuator, limits = axis.feedforward.actuator(), axis.limits
    static_gain = abs(axis.model.transfer().dc_gain) if axis.model else 1.0
    low_end_um, high_end_um = (end_um / static_gain for end_um in sensor_ends_um)
    sensor_um = max(high_end_um if actuator.weights.sum() >= 0 else -low_end_um, 0.0)
    largest_um = min(limits.command_um, axis.interlocks.position_um / static_gain, sensor_um)
    low_um, high_um = reachable_range(actuator, limits.lowest_v, limits.drive_v, largest_um)
    low_um = max(low_um, low_end_um)
    return PositionRange(low_um, max(min(high_um, high_end_um), low_um))


def middle_um(axis: AxisOptions, sensor_ends_um: tuple[float, float]) -> float:
    """Return the position in µm about which an axis moves by default, three digits: 0 for a drive of both signs, else
    the middle of `one_sided_range`.
    """
    if axis.limits.lowest_v < 0:
        return 0.0
    return float(f"{sum(one_sided_range(axis, sensor_ends_um)) / 2:.3g}")


def _stroke_ratio(axis: AxisOptions, rig_plays: PlayModel) -> float | None:
    """Return the rig's position divided by the position of the feedforward's model, both at the drive limits.drive_v.

    The ratio is below 0 if the two move in opposite directions. None if either has no plays or stays at 0.
    """
    _, stroke_um = drive_ends_um(axis)
    rig_stroke_um = float(loading_curve(rig_plays, axis.limits.drive_v))
    return rig_stroke_um / stroke_um if rig_stroke_um and stroke_um else None


def _weights(configuration: Configuration, axis: AxisOptions) -> Iterator[str]:
    """Yield one line if the weights of the feedforward seem to belong to another actuator, else none.

    Their stroke is then below the noise of the simulated sensor; differs from the simulated actuator's stroke by more
    than the factor LARGEST_STROKE_RATIO or in sign; or exceeds the sensor's range and the position interlock by this
    factor.
    """
    key, reach_um = f"axis.{axis.name}.feedforward.weights_um_per_v", max(np.abs(drive_ends_um(axis)))
    plant, limits = simulated_plant(configuration, axis.name), axis.interlocks
    ends = f"{key}: with these weights the drive's limits reach {reach_um:.4g} µm"
    if plant is not None and reach_um < plant.sensor.noise_um:
        yield (
            f"{ends}, less than the simulated sensor's noise of {plant.sensor.noise_um:g} µm; identify the "
            "weights of the hysteresis on this stage"
        )
        return
    ratio = None if plant is None else _stroke_ratio(axis, plant_plays(plant))
    if ratio is not None and not 1 / LARGEST_STROKE_RATIO <= ratio <= LARGEST_STROKE_RATIO:
        rig_um = abs(ratio) * abs(drive_ends_um(axis)[1])
        low_um, high_um = rig_um / LARGEST_STROKE_RATIO, rig_um * LARGEST_STROKE_RATIO
        sign = " in the opposite direction" if ratio < 0 else ""
        yield (
            f"{ends}, with the weights of the simulated actuator {rig_um:.4g} µm{sign}; allowed: {low_um:.4g} … "
            f"{high_um:.4g} µm; identify the weights of the hysteresis on this stage"
        )
        return
    sensor_um = max(map(abs, sensor_ends_um(configuration, axis)))
    allowed_um = LARGEST_STROKE_RATIO * max(sensor_um, limits.position_um)
    if reach_um > allowed_um:
        yield (
            f"{ends}; the sensor's range ends at {sensor_um:.4g} µm, interlocks.position_um is "
            f"{limits.position_um:g} µm; allowed: up to {allowed_um:.4g} µm; identify the weights of the hysteresis on "
            "this stage"
        )


def _sensor_scale(configuration: Configuration, axis: AxisOptions) -> Iterator[str]:
    """Yield a line if `um_per_v` differs from the simulated sensor's by more than SAME_SCALE.

    The scale of a real sensor is not known, and yields no line.
    """
    plant, um_per_v = simulated_plant(configuration, axis.name), configuration.channels[axis.name].um_per_v
    if plant is None or abs((ratio := um_per_v / plant.sensor.um_per_v) - 1) <= SAME_SCALE:
        return
    effect = (
        "with the opposite sign the feedback is positive"
        if ratio < 0
        else f"measured positions are {ratio:.4g} times the true ones"
    )
    yield (
        f"driver.channels.{axis.name}.um_per_v: {um_per_v:g} µm/V, but the simulated sensor has "
        f"{plant.sensor.um_per_v:g} µm/V; {effect}"
    )


def _delay(
    configuration: Configuration, axis: AxisOptions, check: AxisCheck, on_rig: AxisCheck | None
) -> Iterator[str]:
    """Yield a line for a model that states less delay than the driver has, unless the model's dynamics are as late as
    the simulated rig, to half a sample.

    The margins are computed with the model's delay.
    """
    if axis.model is None or check.delay_ticks >= driver_delay_ticks(configuration):
        return
    if on_rig is None or _later_ticks(on_rig, check, configuration.loop.rate_hz) > 0.5:
        yield delay_difference(configuration, axis, axis.model.delay_ticks, check)


def _later_ticks(later: AxisCheck, earlier: AxisCheck, rate_hz: float) -> float:
    """Return by how many samples the plant of one check is later than that of another, by their phases at COMPARED."""
    assert later.plant is not None
    assert earlier.plant is not None
    modes = [abs(pole) for plant in (later.plant, earlier.plant) for pole in plant.poles if pole.imag > 0]
    radians = COMPARED * min([*modes, 2 * np.pi * rate_hz / 10])
    ratio = earlier.plant.response(1j * radians) / later.plant.response(1j * radians)
    phases = np.unwrap(np.angle(ratio))
    return later.delay_ticks - earlier.delay_ticks + float(np.median(phases / radians)) * rate_hz


def delay_difference(configuration: Configuration, axis: AxisOptions, model_ticks: int, check: AxisCheck) -> str:
    """Return a line with three delays in samples: `model_ticks` of the model, the driver's, and the one with which the
    margins are computed.
    """
    delay_ticks, kind = driver_delay_ticks(configuration), configuration.driver_kind
    driver_text = (
        f"the simulated rig has driver.latency_ticks = {delay_ticks}"
        if kind == "sim"
        else f"driver {kind!r} uses a sample {delay_ticks} tick after its conversion"
    )
    return (
        f"axis.{axis.name}.model.delay_ticks: {model_ticks}, but {driver_text}; the margins are computed with "
        f"delay_ticks = {check.delay_ticks}"
    )

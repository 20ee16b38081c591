"""A simulated stage with one resonance, from a few figures: configuration, specification, excitations and campaign.

    D(s) = ω²/(s² + 2ζω s + ω²)        C(s) = ki/s,  ki = min(2ζω/3, 0.1 rate)

At its peak, |C(jω) D(jω)| = ki/(2ζω) is at most 1/3. No delay and no higher resonance can make such a loop unstable
there. The second limit keeps the crossover so far below the rate that the delay of two samples costs little phase.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from rtloop.starters.stage_actuator import Actuator, make_actuator
from rtloop.starters.stage_excitation import excitation_values
from rtloop.starters.stage_figures import RATES_HZ, SAMPLES_PER_PERIOD, TRAVEL_V, StageFigures
from rtloop.starters.templates import fill_template

FILES = ("stage.toml", "stage-spec.toml", "stage-sine.toml", "stage-step.toml", "stage-campaign.toml")
DELAY_TICKS = 1
"""Delay of the simulated board: written in tick k, seen in tick k + 2."""
GAIN_MARGIN, LARGEST_GAIN_PER_TICK = 3.0, 0.1
NOISE_SHARE = 1 / 4000
"""Sensor noise in µm rms, and resolution, as a share of the travel: 5 nm for ±20 µm."""
COMMAND_SHARE = 0.95
"""Largest command as a share of the travel within the interlock; the rest is for the sensor's noise and for drift."""
INTERLOCK_TRAVELS, INTERLOCK_V = 2.25, 9.89
"""Position interlock: as a multiple of the travel, and at most the position at this reading. The interlock of the
sensor's range trips at 9.99 V.
"""
SENSOR_MARGIN_V, NOISE_DEVIATIONS = 0.01, 10.0
"""Distance of the interlock from the sensor's lowest reading, and from 0 V in standard deviations of the noise."""
LEAST_DWELL_S, DWELL_DECAYS, RUN_LEVELS = 0.1, 16.0, 5
"""Duration of a level of the reference: at least LEAST_DWELL_S, and so many time constants of the loop's slowest pole,
of which a step takes about three to settle to 5 %; levels in the first run, with the one at which it begins.
"""
SHORTEST_RUN_S, LONGEST_CAMPAIGN_DWELL_S = 2, 10.0
SETTLING_PERIODS, RESPONSE_PER_OMEGA = 4.8, 0.15
"""Settling time to specify, in periods of the resonance; pole of the tracking weight relative to ω."""


def stage_files(figures: StageFigures) -> dict[str, str]:
    """Return the texts of FILES by name: the loop, its specification, a slow sine and a step without controller, and a
    campaign.
    """
    values = _values(figures)
    values["rig"] = fill_template("stage-rig.toml", **values).rstrip("\n")
    return {name: fill_template(name, **values) for name in FILES}


def stage_actuator(figures: StageFigures) -> Actuator:
    """Return the actuator of a stage."""
    lowest_v = -figures.drive_v if figures.drive_min_v is None else figures.drive_min_v
    return make_actuator(lowest_v, figures.drive_v, figures.range_um, figures.hysteresis_percent)


def _values(figures: StageFigures) -> dict[str, object]:
    """Return the values of the names in all templates: numbers, or texts as they stand in TOML."""
    actuator = stage_actuator(figures)
    um_per_v = figures.sensor_um_per_v or figures.range_um / TRAVEL_V
    noise_um, resolution_um = _sensor_um(figures)
    position_um = min(INTERLOCK_TRAVELS * figures.range_um, INTERLOCK_V * um_per_v)
    loop_numbers = _loop_numbers(figures, actuator)
    numbers = {
        "sensor_um_per_v": um_per_v,
        "noise_um": noise_um,
        "resolution_um": resolution_um,
        "position_um": position_um,
        **loop_numbers,
        **_travel_numbers(figures.range_um, min(figures.range_um, position_um), max(actuator.lowest_um, 0.0)),
    }
    rate_hz = _rate_hz(figures)
    period_ticks = rate_hz / figures.resonance_hz
    return {
        "headline": _headline(figures, actuator),
        "rate_hz": f"{rate_hz:.7g}",
        **{name: _number(value) for name, value in numbers.items()},
        "hysteresis_percent": f"{actuator.hysteresis_percent:.3g}",
        "thresholds_v": _numbers(actuator.thresholds_v),
        "weights_um_per_v": _numbers(actuator.weights_um_per_v),
        "levels": _numbers(_levels_um(actuator, position_um)),
        **_sensor_min_lines(figures.sensor_min_v, noise_um / um_per_v),
        "delay_ticks": DELAY_TICKS,
        "run_duration_s": max(SHORTEST_RUN_S, math.ceil(RUN_LEVELS * loop_numbers["dwell_s"])),
        "swing_ticks": math.ceil(1.5 * period_ticks),
        "frozen_ticks": max(50, math.ceil(period_ticks / 2)),
        **excitation_values(figures, actuator, position_um, noise_um, rate_hz),
    }


def _loop_numbers(figures: StageFigures, actuator: Actuator) -> dict[str, float]:
    """Return the numbers of the templates that depend on resonance and drive, by name."""
    omega, rate_hz = 2 * math.pi * figures.resonance_hz, _rate_hz(figures)
    ki_per_s, pole = _integral_gain(figures, rate_hz), RESPONSE_PER_OMEGA * omega
    poles = np.roots([1.0, 2 * figures.damping * omega, omega**2, ki_per_s * omega**2])
    dwell_s = max(LEAST_DWELL_S, DWELL_DECAYS / float(np.min(-poles.real)))
    return {
        "drive_v": actuator.highest_v,
        "drive_min_v": actuator.lowest_v,
        "omega_squared": omega**2,
        "damping_term": 2 * figures.damping * omega,
        "ki_per_s": ki_per_s,
        "dwell_s": dwell_s,
        "campaign_dwell_s": min(dwell_s, LONGEST_CAMPAIGN_DWELL_S),
        "trip_slew_v_per_s": figures.drive_v * min(100.0, figures.resonance_hz),
        "frozen_drive_v": figures.drive_v / 20,
        "settling_ms": 1e3 * SETTLING_PERIODS / figures.resonance_hz,
        "disturbance_hz": figures.resonance_hz / 160,
        "tracking_gain": 1 / 1.1,
        "tracking_zero": 1.1 * pole,
        "tracking_pole": 1e-4 * pole,
    }


def _sensor_min_lines(sensor_min_v: float | None, noise_v: float) -> dict[str, str]:
    """Return the lines of TOML for the lowest reading of the simulated ADC, and for the interlock against a low
    reading, by name; "" if the lowest reading `sensor_min_v` is None.

    The interlock lies SENSOR_MARGIN_V above `sensor_min_v`, or lower: always below the noise at rest, about 0 V, whose
    rms is `noise_v`.
    """
    if sensor_min_v is None:
        return {"adc_lines": "", "sensor_min_line": ""}
    interlock_v = min(sensor_min_v + SENSOR_MARGIN_V, -max(SENSOR_MARGIN_V, NOISE_DEVIATIONS * noise_v))
    comment = f"           # the sensor's lowest reading is {sensor_min_v:g} V\n"
    return {
        "adc_lines": f"\n[driver.plant.adc]\nmin_v = {_number(sensor_min_v)}",
        "sensor_min_line": f"sensor_min_v = {_number(interlock_v)}{comment}",
    }


def _travel_numbers(range_um: float, reach_um: float, remanence_um: float) -> dict[str, float]:
    """Return the templates' numbers that are shares of the travel `range_um`, or of its part `reach_um`, by name.

    `reach_um` is the travel within the position interlock, `remanence_um` the position below which a drive of one
    sign does not bring the stage back; 0 for any other drive.
    """
    return {
        "largest_command_um": COMMAND_SHARE * reach_um,
        "reference_um": COMMAND_SHARE / 1.1 * (reach_um - remanence_um),
        "oscillation_um": range_um / 5,
        "disturbance_um": range_um / 20,
        "disturbance_error_um": range_um / 200,
    }


def _levels_um(actuator: Actuator, position_um: float) -> list[float]:
    """Return the reference's four levels in µm: upper, middle, lower and again the middle one.

    The levels are the middle of the reachable travel, and a quarter of this travel to each side, rounded to about three
    digits of the travel. The position interlock, ±`position_um`, limits the reachable travel.
    """
    top_um = min(actuator.rise_um(actuator.highest_v), position_um)
    bottom_um = max(actuator.lowest_um, -position_um)
    middle_um, quarter_um = (top_um + bottom_um) / 2, (top_um - bottom_um) / 4
    digits = 2 - math.floor(math.log10(top_um))
    levels_um = (middle_um + quarter_um, middle_um, middle_um - quarter_um, middle_um)
    return [round(level_um, digits) + 0.0 for level_um in levels_um]


def _headline(figures: StageFigures, actuator: Actuator) -> str:
    """Return the stage's figures as one line of text."""
    is_symmetric = actuator.lowest_v == -actuator.highest_v
    travel = f"{figures.range_um:.7g} µm for " + ("±" if is_symmetric else "") + f"{figures.drive_v:.7g} V"
    return (
        f"resonance {figures.resonance_hz:.7g} Hz, damping {figures.damping:.7g}, "
        + (f"±{travel}" if is_symmetric else f"{travel}, lowest drive {actuator.lowest_v:.7g} V")
        + f"; loop at {_rate_hz(figures):.7g} Hz"
    )


def _rate_hz(figures: StageFigures) -> float:
    """Return the rate of `figures`; if it is None, the lowest of RATES_HZ with SAMPLES_PER_PERIOD samples in a period
    of the resonance. StageFigures bounds the resonance, so that such a rate exists.
    """
    least_hz = SAMPLES_PER_PERIOD * figures.resonance_hz
    return figures.rate_hz or next(rate_hz for rate_hz in RATES_HZ if rate_hz >= least_hz)


def _integral_gain(figures: StageFigures, rate_hz: float) -> float:
    """Return the gain ki of the integrator in 1/s: a third of the unstable 2ζω, at most a tenth of the rate."""
    unstable_at = 2 * figures.damping * 2 * math.pi * figures.resonance_hz
    return min(unstable_at / GAIN_MARGIN, LARGEST_GAIN_PER_TICK * rate_hz)


def _sensor_um(figures: StageFigures) -> tuple[float, float]:
    """Return noise and resolution of the sensor in µm; one that is None equals the other.

    If both are None, both are NOISE_SHARE of the travel.
    """
    noise_um, resolution_um = figures.sensor_noise_um, figures.sensor_resolution_um
    default_um = NOISE_SHARE * figures.range_um
    if noise_um is None:
        noise_um = default_um if resolution_um is None else resolution_um
    return noise_um, noise_um if resolution_um is None else resolution_um


def _numbers(values: Iterable[float]) -> str:
    """Return values as a TOML array, seven digits each."""
    return f"[{', '.join(map(_number, values))}]"


def _number(value: float) -> str:
    """Return a value as a TOML float of seven digits."""
    text = f"{value:.7g}"
    return text if "." in text or "e" in text else f"{text}.0"

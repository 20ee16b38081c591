"""Excitation of a stage without a controller, within the limits of drive and sensor: a slow sine and a step.

The sine begins at 0 V, as the stage rests there, also where it moves about another drive. A step of the position by x
swings to x (1 + exp(−πζ/√(1 − ζ²))) before it settles. A sensor that shows no position below 0 sees the step down to
half the drive alone, after which the position swings to 0 at most.
"""

from __future__ import annotations

import math

from rtloop.starters.stage_actuator import Actuator
from rtloop.starters.stage_figures import StageFigures

SINE_HZ, RESONANCE_SHARE, SINE_PERIODS = 0.1, 1e-3, 2.5
"""Frequency of the sine, at most this share of the resonance, and its periods in a recording."""
SAMPLES_PER_PERIOD = 10_000
SINE_SHARE, STEP_SHARE, NOISE_DEVIATIONS = 0.95, 0.9, 5.0
"""Share of the position interlock that sine and step may reach, less so many standard deviations of the noise."""
REST_S = 0.1
SHORTEST_LEVEL_S, LONGEST_LEVEL_S, LEVEL_DECAYS = 0.45, 4.5, 6.0
"""Duration of the step's level: time constants of the resonance's decay, within these limits."""


def excitation_values(
    figures: StageFigures, actuator: Actuator, position_um: float, noise_um: float, rate_hz: float
) -> dict[str, object]:
    """Return the values of the templates of sine and step by name, for a position interlock at ±`position_um`.

    Values are numbers, or texts with the digits to print. `noise_um` is the sensor's noise, rms; `rate_hz` is the rate
    of the step's loop: the times between the steps are in its ticks, the duration of the step is in s.
    """
    noise_um *= NOISE_DEVIATIONS
    lowest_v, highest_v = map(_shorten, actuator.drives_within(SINE_SHARE * position_um - noise_um))
    step_v = _step_v(actuator, figures.damping, STEP_SHARE * position_um - noise_um)
    offset_v, amplitude_v = (highest_v + lowest_v) / 2, (highest_v - lowest_v) / 2
    frequency_hz = min(SINE_HZ, RESONANCE_SHARE * figures.resonance_hz)
    decay_s = 1 / (figures.damping * 2 * math.pi * figures.resonance_hz)
    level_s = min(max(SHORTEST_LEVEL_S, LEVEL_DECAYS * decay_s), LONGEST_LEVEL_S)
    numbers = {
        "sine_amplitude_v": amplitude_v,
        "sine_offset_v": offset_v,
        "sine_phase_deg": -math.degrees(math.asin(offset_v / amplitude_v)) + 0.0,
        "sine_frequency_hz": frequency_hz,
        "step_v": step_v,
        "step_low_v": 0.0 if figures.sensor_min_v in (None, -10.0) else step_v / 2,
    }
    return {
        **{name: float(f"{value:.9g}") for name, value in numbers.items()},
        "sine_lowest_v": f"{lowest_v:g}",
        "sine_highest_v": f"{highest_v:g}",
        "sine_duration_s": f"{SINE_PERIODS / frequency_hz:g}",
        "sine_rate_hz": f"{SAMPLES_PER_PERIOD * frequency_hz:g}",
        "step_up_tick": round(REST_S * rate_hz),
        "step_down_tick": round((REST_S + level_s) * rate_hz),
        "step_duration_s": f"{REST_S + 2 * level_s:.4g}",
    }


def _step_v(actuator: Actuator, damping: float, limit_um: float) -> float:
    """Return the largest drive in V, to three digits, whose step from rest swings at most to `limit_um`."""
    overshoot = math.exp(-math.pi * damping / math.sqrt(1 - damping**2))
    return _shorten(actuator.drives_within(limit_um / (1 + overshoot))[1])


def _shorten(value: float) -> float:
    """Return a value cut, towards 0, to three significant digits."""
    if value == 0.0:
        return 0.0
    scale = 10.0 ** (2 - math.floor(math.log10(abs(value))))
    return math.trunc(value * scale * (1 + 1e-9)) / scale

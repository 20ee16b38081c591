"""A simulated stage with one resonance, from a few figures: its configuration and its specification.

    D(s) = ω²/(s² + 2ζω s + ω²)        C(s) = ki/s,  ki = min(2ζω/3, 0.1 rate)

At its peak, |C(jω) D(jω)| = ki/(2ζω) is at most 1/3. No delay and no higher resonance can make such a loop unstable
there. The second limit keeps the crossover so far below the rate that the delay of two samples costs little phase.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from rtloop.starters.templates import fill_template

RATES_HZ = (10_000.0, 20_000.0, 50_000.0, 100_000.0)
SAMPLES_PER_PERIOD, LEAST_SAMPLES_PER_PERIOD = 10, 4
"""Samples in a period of the resonance: at a rate that is chosen, and at least at a rate that is given."""
DELAY_TICKS = 1
"""Delay of the simulated board: written in tick k, seen in tick k + 2."""
GAIN_MARGIN, LARGEST_GAIN_PER_TICK = 3.0, 0.1
THRESHOLDS = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8)
"""Thresholds of the actuator's play operators, as fractions of the largest drive."""
WEIGHTS = (1.3, 0.3, 0.2, 0.3, 0.2, 0.2)
"""Weights of the play operators, relative to one another: the loop of the hysteresis is as wide as of a piezo stack."""
NOISE_SHARE = 1 / 4000
"""Sensor noise in µm rms, and resolution, as a share of the travel: 5 nm for ±20 µm."""
COMMAND_SHARE = 0.95
"""Largest command as a share of the travel; the rest is for the sensor's noise and for drift."""
SETTLING_PERIODS, RESPONSE_PER_OMEGA = 4.8, 0.15
"""Settling time to specify, in periods of the resonance; pole of the tracking weight relative to ω."""


@dataclass(frozen=True)
class StageFigures:
    """Figures of a stage. None: a value that suits the others."""

    resonance_hz: float = 800.0
    damping: float = 0.02
    """Damping ratio ζ of the resonance."""
    range_um: float = 20.0
    """Travel to each side: the position at rest at +`drive_v`."""
    drive_v: float = 10.0
    sensor_noise_um: float | None = None
    """White noise of the sensor, rms."""
    sensor_resolution_um: float | None = None
    rate_hz: float | None = None

    def __post_init__(self) -> None:
        """Require figures within their ranges. Raises ValueError, one sentence for the first that is not."""
        _require("resonance-hz", self.resonance_hz, 1.0, RATES_HZ[-1] / SAMPLES_PER_PERIOD, "Hz")
        _require("damping", self.damping, 0.001, 0.9, "")
        _require("range-um", self.range_um, 0.01, 10_000.0, "µm")
        _require("drive-v", self.drive_v, 0.1, 10.0, "V")
        for name, value in (
            ("sensor-noise-um", self.sensor_noise_um),
            ("sensor-resolution-um", self.sensor_resolution_um),
        ):
            if value is not None:
                _require(name, value, 0.0, self.range_um / 20, "µm, a twentieth of the travel")
        if self.rate_hz is not None:
            least_hz = LEAST_SAMPLES_PER_PERIOD * self.resonance_hz
            _require("rate-hz", self.rate_hz, least_hz, RATES_HZ[-1], "Hz, from four samples in a period on")


def stage_files(figures: StageFigures) -> dict[str, str]:
    """Return the texts of stage.toml and stage-spec.toml by name."""
    values = _values(figures)
    return {name: fill_template(name, **values) for name in ("stage.toml", "stage-spec.toml")}


def _require(name: str, value: float, least: float, largest: float, unit: str) -> None:
    """Raise ValueError for a value beyond `least` … `largest`, or NaN."""
    if not least <= value <= largest:
        raise ValueError(f"--{name}: value is {value:g}; allowed: {least:g} … {largest:g} {unit}".rstrip())


def _values(figures: StageFigures) -> dict[str, object]:
    """Return the values of both templates by name: numbers as TOML floats, counts of ticks as integers."""
    omega, drive_v, range_um = 2 * math.pi * figures.resonance_hz, figures.drive_v, figures.range_um
    rate_hz = figures.rate_hz or _suitable_rate_hz(figures.resonance_hz)
    period_ticks = rate_hz / figures.resonance_hz
    ki_per_s = _integral_gain(figures, rate_hz)
    noise_um, resolution_um = _sensor_um(figures)
    scale = range_um / sum(
        weight * drive_v * (1 - threshold) for weight, threshold in zip(WEIGHTS, THRESHOLDS, strict=True)
    )
    pole = RESPONSE_PER_OMEGA * omega
    numbers = {
        "half_range_um": range_um / 2,
        "largest_command_um": COMMAND_SHARE * range_um,
        "drive_v": drive_v,
        "sensor_um_per_v": range_um / 4,
        "noise_um": noise_um,
        "resolution_um": resolution_um,
        "omega_squared": omega**2,
        "damping_term": 2 * figures.damping * omega,
        "ki_per_s": ki_per_s,
        "dwell_s": max(0.1, 5 / ki_per_s),
        "trip_slew_v_per_s": drive_v * min(100.0, figures.resonance_hz),
        "position_um": 2.25 * range_um,
        "oscillation_um": range_um / 5,
        "frozen_drive_v": drive_v / 20,
        "settling_ms": 1e3 * SETTLING_PERIODS / figures.resonance_hz,
        "disturbance_um": range_um / 20,
        "disturbance_error_um": range_um / 200,
        "disturbance_hz": figures.resonance_hz / 160,
        "reference_um": COMMAND_SHARE / 1.1 * range_um,
        "tracking_gain": 1 / 1.1,
        "tracking_zero": 1.1 * pole,
        "tracking_pole": 0.001 * pole,
    }
    return {
        "headline": (
            f"resonance {figures.resonance_hz:.7g} Hz, damping {figures.damping:.7g}, ±{range_um:.7g} µm for "
            f"±{drive_v:.7g} V; loop at {rate_hz:.7g} Hz"
        ),
        "rate_hz": f"{rate_hz:.7g}",
        **{name: _number(value) for name, value in numbers.items()},
        "thresholds_v": _numbers(drive_v * threshold for threshold in THRESHOLDS),
        "weights_um_per_v": _numbers(scale * weight for weight in WEIGHTS),
        "delay_ticks": DELAY_TICKS,
        "swing_ticks": math.ceil(1.5 * period_ticks),
        "frozen_ticks": max(50, math.ceil(period_ticks / 2)),
    }


def _suitable_rate_hz(resonance_hz: float) -> float:
    """Return the lowest of RATES_HZ with SAMPLES_PER_PERIOD samples in a period of the resonance."""
    return next(rate_hz for rate_hz in RATES_HZ if rate_hz >= SAMPLES_PER_PERIOD * resonance_hz)


def _integral_gain(figures: StageFigures, rate_hz: float) -> float:
    """Return the gain ki of the integrator in 1/s (see the module's equation)."""
    unstable_at = 2 * figures.damping * 2 * math.pi * figures.resonance_hz
    return min(unstable_at / GAIN_MARGIN, LARGEST_GAIN_PER_TICK * rate_hz)


def _sensor_um(figures: StageFigures) -> tuple[float, float]:
    """Return noise and resolution of the sensor in µm; one that is None equals the other, or has its NOISE_SHARE."""
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

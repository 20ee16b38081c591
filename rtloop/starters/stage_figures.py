"""Figures of a simulated stage, with their ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

RATES_HZ = (10_000.0, 20_000.0, 50_000.0, 100_000.0)
SAMPLES_PER_PERIOD, LEAST_SAMPLES_PER_PERIOD = 10, 4
"""Samples in a period of the resonance: at a rate that is chosen, and at least at a rate that is given."""
LARGEST_HYSTERESIS_PERCENT = 30.0
TRAVEL_V = 4.0
"""Reading at the end of the travel of a sensor whose scale is not given."""


@dataclass(frozen=True)
class StageFigures:
    """Figures of a stage. None: a value that suits the others."""

    resonance_hz: float = 800.0
    damping: float = 0.02
    """Damping ratio ζ of the resonance."""
    range_um: float = 20.0
    """Position at `drive_v`, reached from rest; to the other side it is as large where the drive is."""
    drive_v: float = 10.0
    sensor_noise_um: float | None = None
    """White noise of the sensor, rms."""
    sensor_resolution_um: float | None = None
    rate_hz: float | None = None
    drive_min_v: float | None = None
    """Lowest drive, −`drive_v` to 0."""
    hysteresis_percent: float | None = None
    """Largest difference of the positions at one drive, between rising and falling drive, in percent of the stroke.

    The drive moves over its whole range, often enough that the loop repeats.
    """
    sensor_um_per_v: float | None = None
    sensor_min_v: float | None = None
    """Lowest reading of the sensor, −10 to 0 V; the stage rests at 0 V."""

    def __post_init__(self) -> None:
        """Require figures within their ranges. Raises ValueError, one sentence for the first that is not."""
        _require("resonance-hz", self.resonance_hz, 1.0, RATES_HZ[-1] / SAMPLES_PER_PERIOD, "Hz")
        _require("damping", self.damping, 0.001, 0.9, "")
        _require("range-um", self.range_um, 0.01, 10_000.0, "µm")
        _require("drive-v", self.drive_v, 0.1, 10.0, "V")
        if self.drive_min_v is not None:
            _require("drive-min-v", self.drive_min_v, -self.drive_v, 0.0, "V (minus --drive-v to 0)")
        if self.hysteresis_percent is not None:
            _require("hysteresis-percent", self.hysteresis_percent, 0.0, LARGEST_HYSTERESIS_PERCENT, "%")
        if self.sensor_um_per_v is not None:
            lowest, highest = self.range_um / 20, 10 * self.range_um
            unit = "µm/V, so that ±10 V at the sensor are half of the travel or more"
            _require("sensor-um-per-v", self.sensor_um_per_v, lowest, highest, unit)
        if self.sensor_min_v is not None:
            _require("sensor-min-v", self.sensor_min_v, -10.0, 0.0, "V, as the stage rests at 0 V")
            if self.sensor_min_v > -10.0 and self.drive_min_v != 0.0:
                raise ValueError(
                    f"--sensor-min-v: value is {self.sensor_min_v:g}; allowed: -10, or -10 … 0 with --drive-min-v=0. A "
                    "drive below 0 V makes the sensor's reading negative; add --drive-min-v=0"
                )
        for name, value in (
            ("sensor-noise-um", self.sensor_noise_um),
            ("sensor-resolution-um", self.sensor_resolution_um),
        ):
            if value is not None:
                _require(name, value, 0.0, self.range_um / 20, "µm, a twentieth of the travel")
        if self.rate_hz is not None:
            least_hz = LEAST_SAMPLES_PER_PERIOD * self.resonance_hz
            unit = f"Hz, at least {LEAST_SAMPLES_PER_PERIOD} samples in a period of the resonance"
            _require("rate-hz", self.rate_hz, least_hz, RATES_HZ[-1], unit)


def stage_figures(values: Mapping[str, float]) -> StageFigures:
    """Return the figures of a stage from options by their names, which are the fields of StageFigures and two more.

    `gain_um_per_v` is converted to range_um, `sensor_noise_mv` to sensor_noise_um. Raises ValueError for a value out of
    its range, and for two options that set one figure.
    """
    figures = dict(values)
    for option, replaced in (("gain_um_per_v", "range_um"), ("sensor_noise_mv", "sensor_noise_um")):
        if option in figures and replaced in figures:
            names = (f"--{name.replace('_', '-')}" for name in (option, replaced))
            raise ValueError(f"{' and '.join(names)}: the two options set the same property of the stage; use only one")
    if (gain_um_per_v := figures.pop("gain_um_per_v", None)) is not None:
        figures["range_um"] = gain_um_per_v * figures.get("drive_v", StageFigures.drive_v)
    if (noise_mv := figures.pop("sensor_noise_mv", None)) is not None:
        um_per_v = figures.get("sensor_um_per_v", figures.get("range_um", StageFigures.range_um) / TRAVEL_V)
        figures["sensor_noise_um"] = 1e-3 * noise_mv * um_per_v
    return StageFigures(**figures)


def _require(name: str, value: float, lowest: float, highest: float, unit: str) -> None:
    """Raise ValueError for a value beyond `lowest` … `highest`, or NaN."""
    if not lowest <= value <= highest:
        raise ValueError(f"--{name}: value is {value:g}; allowed: {lowest:g} … {highest:g} {unit}".rstrip())

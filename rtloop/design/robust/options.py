"""Options of [scenarios], [robust] and [shape]: plants to tolerate, limits and effort of the controller and tap
designs.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from rtloop.foundation.options import Numbers, Options

Ticks = Annotated[tuple[int, ...], Field(strict=False)]
MOST_DELAY = 16
"""Largest delay of a scenario in samples."""
MOST_TAPS = 128
"""Largest number of taps in a row."""


class ScenarioOptions(Options):
    """Plants around a model: frequency and damping of each lightly damped mode, gain and delay may differ from it."""

    resonance_percent: float = Field(default=10.0, ge=0, lt=50)
    """Change of each lightly damped mode's frequency, up and down, independently."""
    damping: Annotated[Numbers, Field(min_length=1)] = (0.5, 2.0)
    """Factors on the damping ratio of lightly damped modes."""
    gain_percent: float = Field(default=5.0, ge=0, lt=100)
    """Change of the gain, up and down: D(0), the sensor's scale and the slope left by hysteresis together."""
    delay_ticks: Ticks = ()
    """All possible delays, in place of the model's delay; empty means the model's alone."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError unless damping factors are from 0.01 to 10 and delays from 0 to MOST_DELAY samples."""
        if not all(0.01 <= factor <= 10 for factor in self.damping):
            raise ValueError(f"damping: {list(self.damping)}; allowed: factors from 0.01 to 10")
        if not all(0 <= ticks <= MOST_DELAY for ticks in self.delay_ticks):
            raise ValueError(f"delay_ticks: {list(self.delay_ticks)}; allowed: 0 to {MOST_DELAY} samples")
        return self


class RobustOptions(Options):
    """Limits on a controller, and the effort of the search."""

    largest_sensitivity: float = Field(default=2.0, gt=1)
    """Largest accepted max |S|."""
    noise_gain: float = Field(default=3.0, gt=0)
    """Largest rms of v per rms of white sensor noise."""
    decay_ms: float | None = Field(default=None, gt=0)
    """Longest accepted time constant of the slowest mode near a resonance; None means as short as possible."""
    biquads: int = Field(default=2, ge=1, le=5)
    """Second-order sections behind the PI part."""
    seed: int = Field(default=1, ge=0)
    """Seed of the random numbers of search and proof."""
    restarts: int = Field(default=8, ge=1, le=1000)
    """Number of short searches, each from its own random start; the best of them are continued."""
    generations: int = Field(default=1500, ge=1, le=1_000_000)
    """Generations of the searches that run to the end."""


class ShapeOptions(Options):
    """Options of the reference taps, and the plants that they must fit."""

    taps: int = Field(default=48, ge=2, le=MOST_TAPS)
    """Number of taps in each row."""
    settling_ms: float | None = Field(default=None, gt=0)
    """Settling time, reached with the least variation of v; None means the shortest possible."""
    undershoot_percent: float = Field(default=5.0, ge=0, lt=100)
    """Largest undershoot, relative to the step."""
    band_percent: float = Field(default=5.0, gt=0, le=5)
    """Band around the final value in which a step stays after the settling time; less than 5 % leaves room for
    nonlinear effects.
    """
    points_per_tick: int = Field(default=10, ge=1, le=20)
    """Points per tick at which the position is judged."""
    scenarios: ScenarioOptions = ScenarioOptions(resonance_percent=5.0, damping=(1.0,), gain_percent=0.0)
    """Plants for which the taps must meet the requirements, by default with the resonance 5 % lower and higher."""

"""What a user may say of plants that a loop must bear, and of how its controller and its taps are looked for."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from rtloop.hil.options import Numbers, Options

Ticks = Annotated[tuple[int, ...], Field(strict=False)]
MOST_DELAY = 16
MOST_TAPS = 128
"""Of a row."""


class ScenarioOptions(Options):
    """Plants around a model: each light mode's frequency and damping, the gain and the delay may differ from it."""

    resonance_percent: float = Field(default=10.0, ge=0, lt=50)
    """Of each light mode by itself, up and down."""
    damping: Annotated[Numbers, Field(min_length=1)] = (0.5, 2.0)
    """Factors on the damping ratio of light modes."""
    gain_percent: float = Field(default=5.0, ge=0, lt=100)
    """Up and down: D(0), the sensor's scale, the slope that hysteresis leaves."""
    delay_ticks: Ticks = ()
    """Instead of the model's one: every delay that may occur."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not all(0.01 <= factor <= 10 for factor in self.damping):
            raise ValueError(f"damping {list(self.damping)}: factors from 0.01 to 10 are allowed")
        if not all(0 <= ticks <= MOST_DELAY for ticks in self.delay_ticks):
            raise ValueError(f"delay_ticks {list(self.delay_ticks)}: 0 to {MOST_DELAY} samples are allowed")
        return self


class RobustOptions(Options):
    """Walls for a controller, and the effort of the search."""

    largest_sensitivity: float = Field(default=2.0, gt=1)
    """max |S|."""
    noise_gain: float = Field(default=3.0, gt=0)
    """v, rms, per rms of white noise of the sensor."""
    decay_ms: float | None = Field(default=None, gt=0)
    """Time constant of the slowest mode around a resonance that is still accepted; none: as fast as can be found."""
    biquads: int = Field(default=2, ge=1, le=5)
    """Second-order sections behind the PI part."""
    seed: int = Field(default=1, ge=0)
    restarts: int = Field(default=8, ge=1, le=1000)
    generations: int = Field(default=1500, ge=1, le=1_000_000)
    """Of the searches that are taken to the end."""


class ShapeOptions(Options):
    """Taps for the reference, and the plants that they are to fit."""

    taps: int = Field(default=48, ge=2, le=MOST_TAPS)
    """Of each row."""
    settling_ms: float | None = Field(default=None, gt=0)
    """Settle by then, with the least variation of v; none: as fast as can be."""
    undershoot_percent: float = Field(default=5.0, ge=0, lt=100)
    band_percent: float = Field(default=5.0, gt=0, le=5)
    """Around the final value, in which a step is to stay from the settling time on: less leaves room within ±5 % for
    what is not linear."""
    points_per_tick: int = Field(default=10, ge=1, le=20)
    """At which the position is judged, between ticks too."""
    scenarios: ScenarioOptions = ScenarioOptions(resonance_percent=5.0, damping=(1.0,), gain_percent=0.0)

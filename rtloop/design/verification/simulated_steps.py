"""Figures of simulated steps and of rest, and their comparison with a specification."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from rtloop.design.synthesis.specification import QUANTITIES
from rtloop.design.verification.judgement import Limit
from rtloop.hysteresis.reach import PositionRange

STEP_QUANTILE = 0.95
"""Quantile of the steps that is reported."""
LARGEST_SPREAD, SPREAD_PERCENT = 0.1, 0.5
"""Spread beyond which noise determines a figure: fraction of a settling time, and percentage points."""
JUDGED_QUANTITIES = ("overshoot_percent", "settling_ms", "static_error_percent")
"""Specified figures of a step, in the order of `measure_steps`."""


class SimulatedStep(NamedTuple):
    """Figures of the steps of one height, up and down: the STEP_QUANTILE quantile, the median (`typical`, in the
    order of JUDGED_QUANTITIES), active limits, trips, and the lowest and highest level (`levels_um`).

    A quantile, because the worst of a few steps changes from run to run: noise decides when a loop leaves its dead
    band.
    """

    height_um: float
    overshoot_percent: float
    settling_ms: float
    static_error_percent: float
    typical: tuple[float, ...]
    peak_drive_v: float
    limited: tuple[str, ...]
    trips: tuple[str, ...]
    levels_um: tuple[float, float] = (0.0, 0.0)

    def is_repeatable(self, name: str) -> bool:
        """Whether noise does not decide the figure `name`: its quantile exceeds the median by at most SPREAD_PERCENT
        points, or for the settling time by LARGEST_SPREAD of the quantile. An infinite quantile needs an infinite
        median.
        """
        quantile, median = getattr(self, name), self.typical[JUDGED_QUANTITIES.index(name)]
        if math.isinf(quantile):
            return math.isinf(median)
        return quantile - median <= (SPREAD_PERCENT if name.endswith("percent") else LARGEST_SPREAD * quantile)


@dataclass(frozen=True)
class SimulationResult:
    """Simulated steps, heights outside the range (`omitted_heights_um`), and rms noise of position x and command v at
    rest.

    `truth` names the simulated system, `command_range` has the static commands that are possible. `required` has the
    limits, which count for steps of `counted_heights_um` alone.
    """

    truth: str
    steps: tuple[SimulatedStep, ...]
    omitted_heights_um: tuple[float, ...]
    command_range: PositionRange
    noise_x_nm: float
    noise_v_nm: float
    required: Mapping[str, Limit]
    counted_heights_um: tuple[float, ...]

    def is_met(self, step: SimulatedStep, name: str) -> bool | None:
        """Whether a step meets the limit on figure `name`, judged or not; None without limit."""
        return self.required[name].accepts(getattr(step, name)) if name in self.required else None

    @property
    def violations(self) -> list[str]:
        """Requirements that count and are not met, as `_missed` has them, and counted heights outside the range."""
        return self._missed(counts=True) + [
            f"steps of {height:g} µm, which the command's range of {self.command_range} has no room for"
            for height in self.omitted_heights_um
            if height in self.counted_heights_um
        ]

    @property
    def uncounted_violations(self) -> list[str]:
        """Requirements that steps of other heights do not meet, as `_missed` has them."""
        return self._missed(counts=False)

    def _missed(self, *, counts: bool) -> list[str]:
        """Return a text for each height and figure that misses its limit, then one for each height whose steps trip."""
        steps = [step for step in self.steps if (step.height_um in self.counted_heights_um) == counts]
        return [
            f"{QUANTITIES[name][0]} of {step.height_um:g} µm steps"
            for step in steps
            for name in JUDGED_QUANTITIES
            if self.is_met(step, name) is False
        ] + [f"steps of {step.height_um:g} µm, which trip" for step in steps if step.trips]

    def as_dict(self) -> dict[str, object]:
        """Return the result for JSON: `truth`; `steps`, each with the fields of SimulatedStep and `met` {figure:
        whether it meets its limit}, without figures that have no limit; `left_out_um`, the omitted heights; `range_um`
        [low, high]; `noise_x_nm`; `noise_v_nm`; `judged`, whether any height counts; `counted_um`, these. Infinite
        figures are still infinite, not null.
        """
        steps = [
            {
                **step._asdict(),
                "met": {name: self.is_met(step, name) for name in JUDGED_QUANTITIES if name in self.required},
            }
            for step in self.steps
        ]
        return {
            "truth": self.truth,
            "steps": steps,
            "left_out_um": list(self.omitted_heights_um),
            "range_um": list(self.command_range),
            "noise_x_nm": self.noise_x_nm,
            "noise_v_nm": self.noise_v_nm,
            "judged": bool(self.counted_heights_um),
            "counted_um": list(self.counted_heights_um),
        }

"""Margins of a measured loop with their standard deviations.

The definitions are those of a computed loop (`rtloop.analysis.margins`), as far as the measured band goes. Uncertainty
is carried over by what a change by one standard deviation does: of L in magnitude, of L in phase, and of the light
mode in frequency and in damping.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from rtloop.analysis.margins import Margins, margins
from rtloop.analysis.measured.loop import MeasuredLoop


class Uncertain(NamedTuple):
    """A value with its standard deviation; NaN: not in the measured band."""

    value: float
    std: float


@dataclass(frozen=True)
class MeasuredMargins:
    """Frequencies in Hz, phase in degrees, gain as a factor, the modulus margin min |1 + L|."""

    crossover_hz: Uncertain
    phase_margin_deg: Uncertain
    gain_margin: Uncertain
    gain_margin_hz: Uncertain
    modulus_margin: Uncertain
    max_sensitivity: Uncertain
    max_sensitivity_hz: Uncertain


def measured_margins(loop: MeasuredLoop, with_moved_mode: Sequence[MeasuredLoop] = ()) -> MeasuredMargins:
    """Of a measured loop, and of what it would be with each figure of its light mode off by a standard deviation."""
    half = math.sqrt(0.5)  # of each part of a complex number
    nominal, *perturbed = map(margins, (loop, loop.moved(half), loop.moved(1j * half), *with_moved_mode))

    def uncertain(name: str) -> Uncertain:
        value = getattr(nominal, name)
        if not math.isfinite(value):
            return Uncertain(math.nan, math.nan)
        return Uncertain(
            value, math.hypot(*(getattr(perturbed_margins, name) - value for perturbed_margins in perturbed))
        )

    fields = {name: uncertain(name) for name in Margins._fields}
    peak = fields["max_sensitivity"]
    return MeasuredMargins(modulus_margin=Uncertain(1 / peak.value, peak.std / peak.value**2), **fields)

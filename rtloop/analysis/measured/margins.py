"""Margins of a measured loop with their standard deviations.

The definitions are as for a computed loop (`rtloop.analysis.margins`), as far as the measured band goes. Uncertainty
follows from changes by one standard deviation: of L in magnitude, of L in phase, and of the lightly damped mode in
frequency and in damping.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from rtloop.analysis.margins import Margins, loop_margins
from rtloop.analysis.measured.loop import MeasuredLoop


class UncertainValue(NamedTuple):
    """A value with its standard deviation; NaN: not in the measured band."""

    value: float
    std: float


@dataclass(frozen=True)
class MeasuredMargins:
    """Frequencies in Hz, phase in degrees, gain as a factor, the modulus margin min |1 + L|,
    each with its deviation.
    """

    crossover_hz: UncertainValue
    phase_margin_deg: UncertainValue
    gain_margin: UncertainValue
    gain_margin_hz: UncertainValue
    modulus_margin: UncertainValue
    max_sensitivity: UncertainValue
    max_sensitivity_hz: UncertainValue


def measured_margins(loop: MeasuredLoop, perturbed_loops: Sequence[MeasuredLoop] = ()) -> MeasuredMargins:
    """Return the margins of a loop with standard deviations; NaN for those outside the measured band.

    In each of `perturbed_loops`, one figure of the lightly damped mode is off by a standard deviation.
    """
    half = math.sqrt(0.5)  # of each part of a complex number
    nominal, *perturbed = map(loop_margins, (loop, loop.perturbed(half), loop.perturbed(1j * half), *perturbed_loops))

    def uncertain(name: str) -> UncertainValue:
        """Return a margin; its `std` is the root sum of squares of its changes in all perturbed loops.

        Both are NaN if the margin is not finite. `std` alone is NaN or inf if it is not finite in a perturbed loop.
        """
        value = getattr(nominal, name)
        if not math.isfinite(value):
            return UncertainValue(math.nan, math.nan)
        return UncertainValue(
            value, math.hypot(*(getattr(perturbed_margins, name) - value for perturbed_margins in perturbed))
        )

    fields = {name: uncertain(name) for name in Margins._fields}
    peak = fields["max_sensitivity"]
    return MeasuredMargins(modulus_margin=UncertainValue(1 / peak.value, peak.std / peak.value**2), **fields)

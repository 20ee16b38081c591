"""Comparison of C(z) with C(s): the effect of discretisation on a controller, in numbers and as warnings.

A controller that cancels a lightly damped resonance needs its notch exactly there. Deviations of C(z) in phase and
magnitude near half the sampling rate are unavoidable; a notch that has moved is not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rtloop.foundation.arrays import Complex, Real, rising_grid
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.transfer import Transfer
from rtloop.values import to_jsonable

LIGHT_DAMPING = 0.2
"""Damping ratio below which a pair of roots counts as a notch (zeros) or a resonance (poles)."""


@dataclass(frozen=True)
class RootShift:
    """Undamped natural frequencies in Hz of a lightly damped pair in C(s) and in C(z) (`discrete_hz`; NaN: not in
    C(z)).

    `damping` is the damping ratio in C(s).
    """

    kind: Literal["notch", "resonance"]
    frequency_hz: float
    discrete_hz: float
    damping: float

    @property
    def relative(self) -> float:
        """Shift as a fraction of the frequency, positive upwards; NaN for a pair that C(z) lacks."""
        return self.discrete_hz / self.frequency_hz - 1


@dataclass(frozen=True)
class ControllerComparison:
    """Deviation of C(z) from C(s): the largest |C(z) − C(s)|/|C(s)| below `up_to_hz`, at `max_deviation_hz`.

    `shifts` has the shift of each notch and resonance, `warnings` a sentence for each that is too large.
    """

    max_deviation: float
    max_deviation_hz: float
    up_to_hz: float
    shifts: tuple[RootShift, ...]
    warnings: list[str]

    def as_dict(self) -> dict[str, object]:
        """Return the fields by name as values for JSON, null for numbers that are not finite; `shifts` is a list of
        {kind, frequency_hz, discrete_hz, damping}.
        """
        return to_jsonable(self)


def compare_controllers(
    transfer: Transfer,
    discrete: DiscreteController,
    up_to_hz: float | None = None,
    largest_shift: float = 0.002,
    largest_part_of_half_width: float = 0.5,
) -> ControllerComparison:
    """Return the largest |C(z) − C(s)|/|C(s)| and the shifts of notches and resonances, with warnings.

    The deviation is over frequencies below `up_to_hz`, at most (and by default) half the sampling rate.

    There is a warning for each shift by more than `largest_shift` of the frequency, or by more than
    `largest_part_of_half_width` of the half-width, which is damping × frequency, and for each pair that C(z) lacks.
    """
    nyquist_hz = 0.5 / discrete.period_s
    limit_hz = min(up_to_hz or nyquist_hz, nyquist_hz)
    hz = _frequencies(transfer, limit_hz)
    reference = transfer.response(2j * np.pi * hz)
    error = np.abs(discrete.response(hz) - reference)
    deviation = np.divide(error, np.abs(reference), out=np.zeros_like(error), where=reference != 0)
    worst_index = int(np.argmax(deviation))
    shifts = _root_shifts("notch", transfer.zeros, discrete.zeros, discrete.period_s)
    shifts += _root_shifts("resonance", transfer.poles, discrete.poles, discrete.period_s)
    large_shifts = [shift for shift in shifts if not _is_tolerable(shift, largest_shift, largest_part_of_half_width)]
    warnings = [_warning(shift, discrete) for shift in large_shifts]
    return ControllerComparison(
        float(deviation[worst_index]), float(hz[worst_index]), limit_hz, tuple(shifts), warnings
    )


def _frequencies(transfer: Transfer, limit_hz: float) -> Real:
    """Return a rising grid in Hz, below `limit_hz`, that is dense at narrow notches and resonances."""
    hz = [np.geomspace(1e-5 * limit_hz, 0.9999 * limit_hz, 1000)]
    for root in _light_pairs(np.concatenate([transfer.zeros, transfer.poles])):
        hz.append((abs(root) + np.linspace(-5, 5, 41) * max(-root.real, 1e-4 * abs(root))) / (2 * math.pi))
    grid = rising_grid(hz)
    return grid[(grid > 0) & (grid < limit_hz)]


def _light_pairs(roots: Complex) -> list[complex]:
    """Return the root with positive imaginary part of each pair with a |damping ratio| below LIGHT_DAMPING, in the
    order of `roots`.

    A pair to the right of the imaginary axis counts like its mirror image to the left.
    """
    return [complex(root) for root in roots if root.imag > 0 and abs(root.real) < LIGHT_DAMPING * abs(root)]


def _root_shifts(
    kind: Literal["notch", "resonance"], roots: Complex, images: Complex, period_s: float
) -> list[RootShift]:
    """Return one RootShift for each lightly damped pair of `roots` (s, in rad/s), in their order.

    A pair is compared with the nearest log(z)/T of `images` (z), each of which is used once. `discrete_hz` is NaN for a
    pair whose |s|/2π is half the sampling rate or above, and where no image is left.
    """
    candidate_roots = list(np.log(images[images.imag > 0]) / period_s)
    shifts: list[RootShift] = []
    for root in _light_pairs(roots):
        image = min(candidate_roots, key=lambda candidate, root=root: abs(candidate - root), default=complex(math.nan))
        candidate_roots = [candidate for candidate in candidate_roots if candidate is not image]
        hz, image_hz = abs(root) / (2 * math.pi), float(abs(image)) / (2 * math.pi)
        shifts.append(RootShift(kind, hz, image_hz if hz < 0.5 / period_s else math.nan, abs(root.real) / abs(root)))
    return shifts


def _is_tolerable(shift: RootShift, largest_shift: float, largest_part: float) -> bool:
    """Whether a shift is within both limits of `compare_controllers`; False for a pair that C(z) lacks.

    `largest_part` is a fraction of the half-width; this limit is at least 1e-5 of the frequency.
    """
    max_shift = min(largest_shift, max(largest_part * shift.damping, 1e-5))  # 1e-5: undamped pairs have no width
    return abs(shift.relative) <= max_shift  # False for NaN


def _warning(shift: RootShift, discrete: DiscreteController) -> str:
    """Return the warning for a pair that moved too far or that C(z) lacks."""
    name = f"method {discrete.method!r} at {1 / discrete.period_s:g} Hz"
    if math.isnan(shift.discrete_hz):
        return (
            f"{name} loses the {shift.kind} at {shift.frequency_hz:.1f} Hz: C(z) has no such {shift.kind}; use a "
            "higher sampling rate"
        )
    part = f", {abs(shift.relative) / shift.damping:.1f} times its half-width" if shift.damping > 1e-5 else ""
    return (
        f"{name} moves the {shift.kind} from {shift.frequency_hz:.1f} Hz to {shift.discrete_hz:.1f} Hz "
        f"(by {100 * shift.relative:+.2f} %{part}); use method 'tustin' with prewarp_hz = {shift.frequency_hz:.6g}, "
        "or method 'matched' or 'foh'"
    )

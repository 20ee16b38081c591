"""The pre-filter between reference and loop: taps and sections toward the error, taps toward the command.

v[k] = Σ f_v[i]·r[k−i] + C(z)·( F_x(z)·r[k] − x[k] ),     F_x = Σ f_x[i] z^−i · sections
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex, Real

MEMORY_TOLERANCE = 1e-12
"""Relative size of a section's response below which it no longer counts."""


@dataclass(frozen=True, eq=False)
class ReferencePath:
    """Pre-filter of the reference: `taps` and then `sections` make the reference of the error, `command_taps` a signal
    that is added to the command.

    A row of `sections` (k, 5) has b0, b1, b2, a1, a2 of a second-order section. The default changes no signal.
    """

    taps: Real = field(default_factory=lambda: np.ones(1))
    command_taps: Real = field(default_factory=lambda: np.empty(0))
    sections: Real = field(default_factory=lambda: np.empty((0, 5)))

    @property
    def has_command_path(self) -> bool:
        """Whether the reference also adds to the command, past the controller."""
        return bool(np.any(self.command_taps))

    @property
    def settling_ticks(self) -> int:
        """Ticks until the pre-filter's response to a step is constant, to MEMORY_TOLERANCE; 1 for a path that changes
        nothing.
        """
        poles = [np.abs(np.roots([1.0, *section[3:]])).max(initial=0.0) for section in self.sections]
        slowest = max(poles, default=0.0)
        ringing = np.log(MEMORY_TOLERANCE) / np.log(slowest) if 0 < slowest < 1 else 2.0
        return max(self.taps.size, self.command_taps.size) + len(self.sections) * int(np.ceil(ringing))

    def error_input(self, values: npt.ArrayLike) -> Real:
        """Return the reference of the error: `values` (…, ticks) filtered by taps and sections, from rest."""
        filtered = _convolve(self.taps, values)
        if len(self.sections):
            from scipy.signal import sosfilt  # a second of import, for the few who have sections

            filtered = sosfilt(np.insert(self.sections, 3, 1.0, axis=1), filtered)
        return np.asarray(filtered, np.float64)

    def command_input(self, values: npt.ArrayLike) -> Real:
        """Return the addition to the command: `values` (…, ticks) filtered by the command's taps, from rest.

        Raises ValueError for a path that has no command taps.
        """
        return _convolve(self.command_taps, values)

    def response(self, points: npt.ArrayLike) -> tuple[Complex, Complex]:
        """Return the responses from the reference to the error's reference (taps and sections), then to the command
        (command's taps), complex (k,) each, at points (k,) of the z plane.
        """
        back = 1 / np.atleast_1d(np.asarray(points, complex))
        error_response = np.polyval(self.taps[::-1], back)
        for b0, b1, b2, a1, a2 in self.sections:
            error_response = error_response * (b0 + b1 * back + b2 * back**2) / (1 + a1 * back + a2 * back**2)
        return np.asarray(error_response, complex), np.polyval(self.command_taps[::-1], back) + 0j * back


UNFILTERED = ReferencePath()


def _convolve(taps: Real, values: npt.ArrayLike) -> Real:
    """Return values (…, ticks) filtered by taps, from rest."""
    signals = np.asarray(values, np.float64)
    return np.apply_along_axis(lambda signal: np.convolve(taps, signal)[: signal.size], -1, signals)

"""Rest of an axis: its reference stands still or its output is off, so that its signals show noise alone."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.signals import Mode

MODE = "mode"


def find_axis(signal: str, axes: Iterable[str]) -> str | None:
    """Return the longest name in `axes` that begins the signal's name and precedes an underscore; None without one."""
    return max((axis for axis in axes if signal.startswith(f"{axis}_")), key=len, default=None)


def reference_signal(axis: str) -> str:
    """Return the name of the signal with an axis's reference: x_reference_um for x."""
    return f"{axis}_reference_um"


def is_at_rest(reference: Real, mode: Real) -> bool:
    """Return whether reference and mode (n,) are constant, or the mode is off throughout; True without any tick.

    NaN stands for lost ticks, which are left out.
    """
    valid = np.isfinite(reference) & np.isfinite(mode)
    reference, mode = reference[valid], mode[valid]
    return not reference.size or bool(np.all(mode == Mode.OFF) or np.ptp(reference) == np.ptp(mode) == 0.0)


class RestDetector:
    """Detector of whether an axis has been at rest in all ticks since `reset`."""

    def __init__(self) -> None:
        """Begin without ticks: the axis counts as at rest."""
        self.reset()

    def reset(self) -> None:
        """Discard all ticks; until the next ticks the axis counts as at rest."""
        self.at_rest = True
        self._last: Real = np.zeros((2, 0))
        """Reference and mode of the newest tick, (2, 1); (2, 0) before the first."""

    def feed(self, reference: Real, mode: Real) -> None:
        """Take reference and mode, each (n,), NaN for lost ticks, of the next ticks.

        Sets `at_rest` to False, until `reset`, unless both are constant from the tick before on or the mode is off.
        """
        samples = np.hstack([self._last, [reference, mode]])
        self.at_rest = self.at_rest and is_at_rest(*samples)
        self._last = samples[:, -1:]

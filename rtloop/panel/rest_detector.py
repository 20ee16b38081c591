"""Whether an axis is at rest: its reference stands still, or nothing drives its output; only noise is seen then."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.signals import Mode

MODE = "mode"


def find_axis(signal: str, axes: Iterable[str]) -> str | None:
    """The axis of a signal, by its name; None for a signal of no axis."""
    return max((axis for axis in axes if signal.startswith(f"{axis}_")), key=len, default=None)


def reference_signal(axis: str) -> str:
    """The signal that is the reference of an axis."""
    return f"{axis}_reference_um"


def is_at_rest(reference: Real, mode: Real) -> bool:
    """Whether reference and mode (n,), NaN where ticks are lost, stand still, or the mode is off throughout."""
    valid = np.isfinite(reference) & np.isfinite(mode)
    reference, mode = reference[valid], mode[valid]
    return not reference.size or bool(np.all(mode == Mode.OFF) or np.ptp(reference) == np.ptp(mode) == 0.0)


class RestDetector:
    """Whether an axis has been at rest since `reset`, of ticks that come in turn."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Judge anew."""
        self.at_rest = True
        self._last: Real = np.zeros((2, 0))
        """Reference and mode of the newest tick."""

    def feed(self, reference: Real, mode: Real) -> None:
        """Judge the next ticks, each (n,), with the one before them."""
        samples = np.hstack([self._last, [reference, mode]])
        self.at_rest = self.at_rest and is_at_rest(*samples)
        self._last = samples[:, -1:]

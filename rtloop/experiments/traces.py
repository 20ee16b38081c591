"""Reduction of long signals for drawing."""

from __future__ import annotations

import numpy as np

from rtloop.foundation.arrays import Real


def envelope(signal: Real, rate_hz: float, points: int = 1500) -> tuple[Real, Real]:
    """Return time in s and signal, (2 × ranges,) each: minimum and maximum of each range of ticks in turn.

    There are about `points` ranges; no peak is lost.
    """
    edges = np.arange(0, signal.size, max(1, signal.size // points))
    low, high = np.minimum.reduceat(signal, edges), np.maximum.reduceat(signal, edges)
    return np.repeat(edges / rate_hz, 2), np.stack([low, high], axis=1).ravel()


def thin_signals(*signals: Real, points: int = 3000) -> tuple[Real, ...]:
    """Return every nth sample of smooth signals (n,) of one length, about `points` of each."""
    step = max(1, signals[0].size // points)
    return tuple(signal[::step] for signal in signals)

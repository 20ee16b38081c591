"""Actuators that are no sums of plays, and one that is, each stepped sample by sample; nothing of rtloop is in here."""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
THRESHOLDS_V = np.array([0.0, 0.6, 1.5, 2.7, 4.1, 5.6, 7.2])
WEIGHTS_UM_PER_V = np.array([2.4, 0.5, 0.45, 0.4, 0.35, 0.3, 0.25])


def sum_of_plays(drive_v: Array) -> Array:
    """µm, from rest."""
    return stepped_plays(drive_v, THRESHOLDS_V, WEIGHTS_UM_PER_V)


def creeping_plays(drive_v: Array) -> Array:
    """µm, from rest: half a micrometre more per volt, with a lag of 100 samples."""
    lag, found = 0.0, []
    for u in drive_v:
        lag += (u - lag) / 100
        found.append(0.5 * lag)
    return sum_of_plays(drive_v) + np.array(found)


def bouc_wen(drive_v: Array) -> Array:
    """x = 4 u − 2 z, dz = 0.8 du − 0.15 |du| z − 0.05 du |z| (Bouc 1967, Wen 1976; n = 1), in µm, from rest."""
    z, last, found = 0.0, 0.0, []
    for u in drive_v:
        for _ in range(10):
            du = (u - last) / 10
            z += 0.8 * du - 0.15 * abs(du) * z - 0.05 * du * abs(z)
        last = u
        found.append(4.0 * u - 2.0 * z)
    return np.array(found)


def preisach(drive_v: Array) -> Array:
    """Relays on at α and off at β ≤ α, on a grid of ±10 V, more of them in the middle (Preisach 1935), in µm."""
    levels = np.linspace(-10, 10, 81)
    on, off = (side.ravel() for side in np.meshgrid(levels, levels))
    on, off = on[on >= off], off[on >= off]
    density = np.exp(-((on + off) ** 2) / 120 - (on - off) ** 2 / 50)
    state, found = np.where(on + off < 0, 1.0, -1.0), []
    for u in drive_v:
        state = np.where(u >= on, 1.0, np.where(u <= off, -1.0, state))
        found.append(state @ density)
    return 40.0 * np.array(found) / density.sum()


def stepped_plays(drive_v: Array, thresholds_v: Array, weights_um_per_v: Array) -> Array:
    """µm, from rest."""
    state, found = np.zeros(thresholds_v.size), []
    for u in drive_v:
        state = np.maximum(u - thresholds_v, np.minimum(u + thresholds_v, state))
        found.append(state @ weights_um_per_v)
    return np.array(found)


def part_of_a_drive(random: np.random.Generator, samples: int, turns: int = 3) -> tuple[Array, Array]:
    """A past and a drive, in V: straight strokes between random turning points, ±9 V among those of the drive, and so
    many behind them."""
    past = _strokes(np.append(0.0, random.uniform(-9, 9, 4)), samples // 2)
    corners = np.concatenate([past[-1:], random.uniform(-9, 9, 1), [-9.0, 9.0], random.uniform(-9, 9, turns)])
    return past, _strokes(corners, samples)


def _strokes(corners: Array, samples: int) -> Array:
    places = np.cumsum(np.append(0.0, np.abs(np.diff(corners))))
    return np.interp(np.linspace(0, places[-1], samples), places, corners)

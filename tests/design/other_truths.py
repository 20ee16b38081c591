"""Reference actuators stepped sample by sample without rtloop: a sum of plays, and three that are no sums of plays."""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
THRESHOLDS_V = np.array([0.0, 0.6, 1.5, 2.7, 4.1, 5.6, 7.2])
WEIGHTS_UM_PER_V = np.array([2.4, 0.5, 0.45, 0.4, 0.35, 0.3, 0.25])


def sum_of_plays(drive_v: Array) -> Array:
    """Return the output (µm), from rest, of plays with this module's thresholds and weights."""
    return step_plays(drive_v, THRESHOLDS_V, WEIGHTS_UM_PER_V)


def creeping_plays(drive_v: Array) -> Array:
    """Return `sum_of_plays` plus a creep of 0.5 µm/V with a lag of 100 samples, in µm, from rest."""
    lag, creep_um = 0.0, []
    for u in drive_v:
        lag += (u - lag) / 100
        creep_um.append(0.5 * lag)
    return sum_of_plays(drive_v) + np.array(creep_um)


def bouc_wen(drive_v: Array) -> Array:
    """Return x = 4 u − 2 z, dz = 0.8 du − 0.15 |du| z − 0.05 du |z| (Bouc 1967, Wen 1976; n = 1), in µm, from rest."""
    z, previous, outputs_um = 0.0, 0.0, []
    for u in drive_v:
        for _ in range(10):
            du = (u - previous) / 10
            z += 0.8 * du - 0.15 * abs(du) * z - 0.05 * du * abs(z)
        previous = u
        outputs_um.append(4.0 * u - 2.0 * z)
    return np.array(outputs_um)


def preisach(drive_v: Array) -> Array:
    """Return the output (µm) of relays, on at α, off at β ≤ α, within ±10 V, densest in the middle (Preisach 1935)."""
    levels = np.linspace(-10, 10, 81)
    on, off = (thresholds.ravel() for thresholds in np.meshgrid(levels, levels))
    on, off = on[on >= off], off[on >= off]
    density = np.exp(-((on + off) ** 2) / 120 - (on - off) ** 2 / 50)
    state, outputs = np.where(on + off < 0, 1.0, -1.0), []
    for u in drive_v:
        state = np.where(u >= on, 1.0, np.where(u <= off, -1.0, state))
        outputs.append(state @ density)
    return 40.0 * np.array(outputs) / density.sum()


def step_plays(drive_v: Array, thresholds_v: Array, weights_um_per_v: Array) -> Array:
    """Return the output (µm), from rest, of a weighted sum of plays."""
    state, outputs_um = np.zeros(thresholds_v.size), []
    for u in drive_v:
        state = np.maximum(u - thresholds_v, np.minimum(u + thresholds_v, state))
        outputs_um.append(state @ weights_um_per_v)
    return np.array(outputs_um)


def random_drive(random: np.random.Generator, samples: int, turns: int = 3) -> tuple[Array, Array]:
    """Return a past and a drive (V): straight strokes between random turning points. The drive reaches −9 V and 9 V,
    then `turns` random points."""
    past = _sample_strokes(np.append(0.0, random.uniform(-9, 9, 4)), samples // 2)
    corners = np.concatenate([past[-1:], random.uniform(-9, 9, 1), [-9.0, 9.0], random.uniform(-9, 9, turns)])
    return past, _sample_strokes(corners, samples)


def _sample_strokes(corners: Array, samples: int) -> Array:
    """Return `samples` points (V), equally spaced along the path through the corners."""
    path_v = np.cumsum(np.append(0.0, np.abs(np.diff(corners))))
    return np.interp(np.linspace(0, path_v[-1], samples), path_v, corners)

"""Static gain of a plant, measured in closed loop: position per command at references that are held in turn.

    x̄_i, v̄_i   means of position and command while reference i is held
    K̂ = Σ |x̄_i+1 − x̄_i| / Σ |v̄_i+1 − v̄_i|

The references go out in equal steps and back in the same ones. A step after a turn is left out: there hysteresis
answers with its narrow loops alone. The slopes of the others scatter by noise and by the hysteresis that an inverse
leaves: that gives the standard deviation of their mean.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtloop.foundation.arrays import Real

STEPS = 8
"""Number of steps in each direction."""
RAMP_S, HELD_S, JUDGED = 0.05, 0.2, 0.5
"""Durations in s of a ramp between references and of each held reference, and the fraction of the latter, at its end,
over which means are taken.
"""


class StaticGain(NamedTuple):
    """µm of position per µm of command with its standard deviation, between two references in µm."""

    value: float
    std: float
    from_um: float
    to_um: float


def staircase(from_um: float, to_um: float, rate_hz: float) -> Real:
    """Return references (ticks,) from one value to the other and back, in STEPS steps each; the last sample is
    `from_um`.

    A ramp of RAMP_S leads to each level, which is held for HELD_S.
    """
    ramp, held = round(RAMP_S * rate_hz), round(HELD_S * rate_hz)
    out = np.linspace(from_um, to_um, STEPS + 1)
    levels = np.concatenate([out, out[-2::-1]])
    rising = 0.5 - 0.5 * np.cos(np.pi * np.arange(ramp) / ramp)
    before = np.concatenate([levels[:1], levels[:-1]])
    ramps = before[:, None] + (levels - before)[:, None] * rising
    return np.hstack([ramps, np.repeat(levels[:, None], held, axis=1)]).ravel()


def static_gain(reference: Real, position: Real, command: Real, rate_hz: float) -> StaticGain:
    """Return the gain and its standard deviation from a recorded `staircase`, with position and command.

    All three are (ticks,), in µm, of the staircase alone.

    The first step in each direction does not count. Raises ValueError unless position and command move the same way at
    each other step.
    """
    count = round(JUDGED * HELD_S * rate_hz)
    x, v = (signal.reshape(2 * STEPS + 1, -1)[:, -count:].mean(axis=1) for signal in (position, command))
    position_steps, command_steps = (np.delete(np.diff(means), [0, STEPS]) for means in (x, v))
    slopes = position_steps / np.where(command_steps == 0, np.nan, command_steps)
    from_um, to_um = float(reference[0]), float(reference.reshape(2 * STEPS + 1, -1)[STEPS, -1])
    if np.all(slopes < 0):
        raise ValueError(
            "gain: the position falls at every step that raises the command; check the signs of sensor and drive"
        )
    if not np.all(slopes > 0):
        raise ValueError(
            f"static gain: a step of the reference between {from_um:g} and {to_um:g} µm did not move command and "
            "position in one direction; use larger steps (gain_um)"
        )
    value = float(np.abs(position_steps).sum() / np.abs(command_steps).sum())
    return StaticGain(value, float(slopes.std(ddof=1)) / float(np.sqrt(slopes.size)), from_um, to_um)

"""Limits of numbers: which are usable, within which range, by which step."""

from __future__ import annotations

from rtloop.foundation.native.compiled import jit

USABLE_MAGNITUDE = 1e9
"""Inputs and references of this magnitude or more, infinite or NaN are not used in a computation."""


@jit
def is_usable(value):
    """Return True for a finite number below USABLE_MAGNITUDE in magnitude."""
    return -USABLE_MAGNITUDE < value < USABLE_MAGNITUDE


@jit
def clip(value, low, high):
    """Return `value` limited to low … high; NaN stays NaN."""
    return low if value < low else (high if value > high else value)


@jit
def step_toward(value, target, step):
    """Return `value` moved toward `target` by at most `step`, which is at least 0."""
    return clip(target, value - step, value + step)

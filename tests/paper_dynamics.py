"""Eq (5) of the paper in python-control, for oracles that share no code with the rig."""

from __future__ import annotations

from typing import Any

import control
import numpy as np


def paper_dynamics() -> Any:
    """Return D(s) of eq (5) as sections in series, since expanded polynomials would lose digits."""
    sections = [
        (np.polymul([1.0, -1.22e5], [1.0, 2.99e4]), [1.0, 925.0, 4.59e5]),
        (np.polymul([1.0, -2.776e4], [1.0, -1.07e4]), [1.0, 55.0, 1.4e7]),
        ([1.0, 1430.0], [1.0, 1.54e4, 4.0e9]),
        ([1.0, 4.3e4, 3.2e9], [1.0, 964.0, 3.95e9]),
    ]
    plant = control.ss([], [], [], [[-20.7]])
    for section in sections:
        plant = control.ss(control.tf(*section)) * plant
    return plant

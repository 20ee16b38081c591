"""Frequency response of a controller, measured with sines through its own functions.

A sine of the error gives a sine of the command, a slow transient, and the offset of an integrator. A fit of all of them
to whole windows is repeated, window after window, until the sine no longer changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex, Real

LEAST_PERIODS, LEAST_TICKS, MOST_TICKS = 2, 256, 400_000
"""Length of a window in periods and ticks, whichever is longer, and the ticks after which the measurement ends."""
AGREEMENT = 1e-5
"""Relative change of the response from one window to the next at which it is settled."""
LEAST_RESPONSE = 1e-9
"""Response below which a change does not count, for example at the zero of a notch without damping."""


def measure_response(
    tick: Callable[[Real], Real],
    restart: Callable[[], None],
    axes: int,
    period_s: float,
    frequencies_hz: npt.ArrayLike,
    amplitude_um: float,
) -> Complex:
    """Return the response (frequencies, axes, axes) from errors, its columns, to commands, its rows.

    `tick` runs one tick with errors (axes,) and returns the commands (axes,), all in µm; `restart` returns to rest. The
    error of one axis at a time is a sine of `amplitude_um`. Raises ValueError for a frequency that is not above 0 and
    below half of the rate, and for a response that does not settle.
    """
    frequencies = np.atleast_1d(np.asarray(frequencies_hz, float))
    highest_hz = 0.5 / period_s
    if not np.all((frequencies > 0) & (frequencies < highest_hz)):
        raise ValueError(f"frequencies_hz: {frequencies.tolist()}; allowed: above 0, below {highest_hz:g} Hz")
    response = np.empty((frequencies.size, axes, axes), complex)
    for row, frequency_hz in enumerate(frequencies):
        for axis in range(axes):
            restart()
            directed_um = amplitude_um * np.eye(axes)[axis]
            response[row, :, axis] = _settled_response(tick, directed_um, frequency_hz, period_s) / amplitude_um
    return response


def _settled_response(
    tick: Callable[[Real], Real], amplitudes_um: Real, frequency_hz: float, period_s: float
) -> Complex:
    """Return the complex amplitudes of the commands (axes,) for errors `amplitudes_um` (axes,) times a sine.

    Raises ValueError if they still change after MOST_TICKS and at least three windows.
    """
    window = max(LEAST_TICKS, math.ceil(LEAST_PERIODS / (frequency_hz * period_s)))
    most_ticks = max(MOST_TICKS, 3 * window)
    previous = np.full(amplitudes_um.size, np.inf + 0j)
    for first in range(0, most_ticks, window):
        ticks = first + np.arange(window)
        phase = 2 * np.pi * frequency_hz * period_s * ticks
        commands_um = np.array([tick(amplitudes_um * value).copy() for value in np.sin(phase)])
        ramp = np.linspace(-1.0, 1.0, window)
        parts = np.column_stack([np.sin(phase), np.cos(phase), np.ones(window), ramp, ramp**2])
        fit = np.linalg.lstsq(parts, commands_um, rcond=None)[0]
        amplitudes = fit[0] + 1j * fit[1]
        negligible_um = LEAST_RESPONSE * np.abs(amplitudes_um).max()
        if np.all(np.abs(amplitudes - previous) <= AGREEMENT * np.abs(amplitudes).max() + negligible_um):
            return amplitudes
        previous = amplitudes
    raise ValueError(f"the response at {frequency_hz:g} Hz has not settled after {most_ticks:,} ticks")

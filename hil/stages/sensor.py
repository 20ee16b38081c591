"""The displacement sensor: offset, noise, resolution, volts. Its bandwidth is one of the modes of `dynamics`.

    reading = resolution · rint((position + offset + noise) / resolution)        V = reading / um_per_v

The paper's sensor (Keyence LC2420) has 10 nm resolution, 100 nm precision and more than 1 kHz bandwidth.
"""

from __future__ import annotations

import numpy as np

from rtloop.foundation.native.compiled import jit
from rtloop.hil.stages import noise

COEFFICIENTS = [
    ("sensor_um_per_v", "f8"),
    ("sensor_offset_um", "f8"),
    ("sensor_noise_um", "f8"),
    ("sensor_resolution_um", "f8"),
]
STATE: list[tuple[str, str]] = []


@jit
def read(coefficients, state, position_um):
    """Return the sensor's output [V] for `position_um`: (position + offset + noise) / um_per_v, in steps of the
    resolution; draw from the axis's noise if the sensor has any.
    """
    reading_um = position_um + coefficients.sensor_offset_um
    if coefficients.sensor_noise_um > 0.0:
        value, state.noise_word = noise.draw_normal(state.noise_word)
        reading_um += coefficients.sensor_noise_um * value
    resolution_um = coefficients.sensor_resolution_um
    if resolution_um > 0.0:
        reading_um = np.rint(reading_um / resolution_um) * resolution_um
    return reading_um / coefficients.sensor_um_per_v

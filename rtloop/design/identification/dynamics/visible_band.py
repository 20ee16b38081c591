"""Band in which a recording shows the dynamics: the driven motion against what the model leaves unexplained."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rtloop.design.identification.dynamics.excitation import LoopExcitation, driven_input, shift_to_zero
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.foundation.arrays import Real

BANDS_PER_OCTAVE = 3


def visible_hz(model: Innovations, run: Excitation) -> float:
    """Return the upper end of the highest third of an octave in which the motion that the input of `run` drives has
    more energy than the output error; 0 if there is none.

    The input is delayed already; in closed loop only what follows from outside drives. Both are differenced, so that
    the jump from the last sample to the first hides nothing.
    """
    run = shift_to_zero(run) if isinstance(run, LoopExcitation) else run
    driven = driven_input(run) if isinstance(run, LoopExcitation) else run.input
    motion = _spectrum(model.simulate_output(driven))
    error = _spectrum(run.position_um - model.simulate_output(run.input))
    hz = np.fft.rfftfreq(run.input.size - 1, run.period_s)
    edges_hz = hz[-1] * 2.0 ** -np.arange(0, np.log2(hz.size), 1 / BANDS_PER_OCTAVE)
    for high_hz, low_hz in pairwise(edges_hz):
        band = (hz > low_hz) & (hz <= high_hz)
        if band.any() and motion[band].sum() > error[band].sum():
            return float(high_hz)
    return 0.0


def _spectrum(signal_um: Real) -> Real:
    """Return the energy of the differences of a signal at each frequency, (samples/2,)."""
    return np.asarray(np.abs(np.fft.rfft(np.diff(signal_um))) ** 2)

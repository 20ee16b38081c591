"""How a recording in open loop begins: at rest at some level of the input, or in motion.

A stage that rests at a bias before it is excited shows the response to changes from that bias. Where the stage moves
from the first sample on, the input before it is unknown: the motion that it left is estimated by the method for closed
loops, in which the input itself is the external signal.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import detrend

from rtloop.design.identification.axis_recording import noise_std
from rtloop.design.identification.dynamics.excitation import LoopExcitation
from rtloop.design.identification.dynamics.prediction_error import Excitation

LEAST_REST_SAMPLES = 100
REST_SPAN, REST_NOISE = 0.02, 8.0
"""At rest the position spans at most this share of its whole span, or this many times its noise."""


def refer_to_beginning(run: Excitation, *, begins_at_0: bool) -> Excitation:
    """Return the recording with its input relative to the level at which the stage rests at the beginning.

    Without a rest of LEAST_REST_SAMPLES, the recording is returned unchanged if `begins_at_0` says that its input was 0
    before the first sample, else as a LoopExcitation whose input is its external signal.
    """
    changes = np.flatnonzero(np.diff(run.input))
    rest = int(changes[0]) + 1 if changes.size else run.input.size
    span_um, noise_um = float(np.ptp(run.position_um)), noise_std(run.position_um)
    if rest >= LEAST_REST_SAMPLES and np.ptp(run.position_um[:rest]) <= max(REST_SPAN * span_um, REST_NOISE * noise_um):
        return replace(run, input=run.input - run.input[0])
    return run if begins_at_0 else LoopExcitation(run.name, run.input, run.position_um, run.period_s, run.input[None])


def without_drift(run: Excitation) -> LoopExcitation:
    """Return the recording without the straight line of each signal; its beginning is estimated."""
    external = run.external if isinstance(run, LoopExcitation) else run.input[None]
    return LoopExcitation(run.name, detrend(run.input), detrend(run.position_um), run.period_s, detrend(external))

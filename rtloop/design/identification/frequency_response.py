"""A frequency response measured from a recorded chirp or multisine, with coherence, and its comparison with a model.

    H₁ = S_ux / S_uu,     γ² = |S_ux|² / (S_uu S_xx)          Welch 1967; Bendat & Piersol 2010, chapter 6
    H = S_wx / S_wu,      γ² = |S_wx|² / (S_ww S_xx)          in closed loop: Wellstead 1981

w is the external excitation of a closed loop, or a signal that follows from it alone: S_ux would contain the noise that
C(z) feeds back.

Where the coherence is low, noise or nonlinearity is measured and not the plant; such frequencies are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import csd, welch

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.dynamics.excitation import LoopExcitation, driven_input, shift_to_zero
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.foundation.arrays import Complex, Real

LEAST_COHERENCE = 0.95
SEGMENT_S = 0.8
"""Length of a segment: a resolution of 1.25 Hz, narrower than a resonance of 595 Hz and damping 0.007."""
LEAST_SEGMENT = 200
"""Least samples of a segment of a recording that is shorter than two segments of SEGMENT_S."""


@dataclass(frozen=True)
class FrequencyResponse:
    """Frequencies `hz`, complex `response` (output per input) and `coherence`, each (k,).

    `resolution_hz` is the distance of the frequencies; narrower peaks are flattened.
    """

    hz: Real
    response: Complex
    coherence: Real
    resolution_hz: float = 1 / SEGMENT_S

    @property
    def is_trusted(self) -> npt.NDArray[np.bool_]:
        """Mask (k,) of the frequencies with a coherence of at least LEAST_COHERENCE."""
        return np.asarray(self.coherence >= LEAST_COHERENCE)


@dataclass(frozen=True)
class Agreement:
    """Model against measurement at the trusted frequencies, `from_hz` … `to_hz`: relative deviations of the complex
    response as fractions, and the frequencies of the peaks.

    `resolution_hz` is the measurement's resolution.
    """

    from_hz: float
    to_hz: float
    resolution_hz: float
    median_deviation: float
    largest_deviation: float
    largest_at_hz: float
    measured_peak_hz: float
    model_peak_hz: float


def estimate_response(
    u: Real, x: Real, period_s: float, segment_s: float = SEGMENT_S, instrument_signal: Real | None = None
) -> FrequencyResponse:
    """Estimate the response from `u` to `x`, each (samples,), by Welch's method: Hann windows, overlap 3/4.

    `instrument_signal` (samples,) is, for a closed loop, its external excitation or a part of `u` that follows from it;
    None takes `u`. 0 Hz and frequencies that are not excited are omitted. Raises UnsuitableData for a recording shorter
    than two segments.
    """
    _require_two_segments(u.size, period_s, segment_s)
    samples = round(segment_s / period_s)
    settings = {"fs": 1 / period_s, "nperseg": samples, "noverlap": 3 * samples // 4}
    reference = u if instrument_signal is None else instrument_signal
    hz, cross = csd(reference, x, **settings)
    input_cross, inputs, outputs = (
        csd(reference, u, **settings)[1],
        welch(reference, **settings)[1],
        welch(x, **settings)[1],
    )
    excited = (hz > 0) & (inputs > 1e-12 * inputs.max()) & (np.abs(input_cross) > 0)
    coherence = np.abs(cross[excited]) ** 2 / (inputs[excited] * np.maximum(outputs[excited], 1e-300))
    response = np.asarray(cross[excited] / input_cross[excited], dtype=complex)
    return FrequencyResponse(hz[excited], response, coherence, 1 / (samples * period_s))


def recording_response(run: Excitation) -> FrequencyResponse:
    """Return the response of a recording from input to position; in closed loop, the part of the input that follows
    from the external excitation is the instrument.

    A recording shorter than two segments of SEGMENT_S gets two segments of half its length. Raises UnsuitableData where
    these have fewer than LEAST_SEGMENT samples, and for external signals that all stand still.
    """
    segment_s = min(SEGMENT_S, run.input.size // 2 * run.period_s)
    _require_two_segments(run.input.size, run.period_s, max(segment_s, LEAST_SEGMENT * run.period_s))
    instrument = driven_input(shift_to_zero(run)) if isinstance(run, LoopExcitation) else None
    return estimate_response(run.input, run.position_um - run.position_um[0], run.period_s, segment_s, instrument)


def _require_two_segments(samples: int, period_s: float, segment_s: float = SEGMENT_S) -> None:
    """Raise UnsuitableData for a recording of `samples` samples that is shorter than two segments."""
    if samples < 2 * round(segment_s / period_s):
        raise UnsuitableData(
            f"the recording has {samples * period_s:g} s of excitation; a frequency response needs at least "
            f"{2 * segment_s:g} s. Record longer"
        )


def compare_responses(model: Innovations, measured_curve: FrequencyResponse) -> Agreement:
    """Compare a sampled model with a measured response at the trusted frequencies.

    Returns the median and the largest of |model − measured|/|measured| as fractions, the frequency of the largest, the
    frequencies at which the measured and the modelled magnitude are largest, the lowest and highest trusted frequency,
    and the resolution, all in Hz. Raises UnsuitableData if no frequency is trusted.
    """
    is_trusted = measured_curve.is_trusted
    if not np.any(is_trusted):
        raise UnsuitableData(
            f"too little excitation: no frequency has a coherence of at least {LEAST_COHERENCE}; use a larger chirp or "
            "multisine"
        )
    hz, measured_points = measured_curve.hz[is_trusted], measured_curve.response[is_trusted]
    predicted = model.discrete().response(np.exp(2j * np.pi * hz * model.period_s))[0]
    deviation = np.abs(predicted - measured_points) / np.abs(measured_points)
    largest_index = int(np.argmax(deviation))
    return Agreement(
        float(hz[0]),
        float(hz[-1]),
        measured_curve.resolution_hz,
        float(np.median(deviation)),
        float(deviation[largest_index]),
        float(hz[largest_index]),
        float(hz[np.argmax(np.abs(measured_points))]),
        float(hz[np.argmax(np.abs(predicted))]),
    )

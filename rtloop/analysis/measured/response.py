"""The response of a closed loop to a periodic reference: plant, controller, loop and sensitivity, with uncertainty.

    x = D v + n,   v = C (w − x) + v_r,   w = e + x        D̂ = X/V,   Ĉ = (V − V_r)/E,   L̂ = Ĉ D̂,   S = 1/(1 + L)

X, V, E are means over the periods. All answer to the same reference, which is independent of the noise n: unlike a
spectral estimate of v and x alone, which tends to −1/C, this gives D whatever the noise (joint input-output
identification; Ljung 1999, section 13.5; Pintelon & Schoukens 2012, section 2.6.4). In the plant's response the loop
turns n into S n at x, so that

    σ(D̂)/|D| = σ(L̂)/|L| = σ(X)/(|S| |X|)

σ(X) comes from silent lines nearby: noise and nonlinearity. The noise alone follows from the differences between the
periods.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtloop.analysis.measured.multisine import LineGrid
from rtloop.foundation.arrays import Complex, Real

SILENT_NEARBY = 10
"""Silent lines, the nearest ones, whose mean power is the uncertainty of an excited one."""


@dataclass(frozen=True)
class PeriodSignals:
    """Periods at the same reference, each (periods, samples): error, command and position, µm.

    `direct` (samples,) is the command's component that comes from the reference past the controller; None: 0.
    """

    error: Real
    command: Real
    position: Real
    direct: Real | None = None


@dataclass(frozen=True)
class MeasuredResponse:
    """Plant D and controller C at `hz` (k,) as measured, with their uncertainty.

    `spread` (k,) is the standard deviation of D̂, and of C D̂, relative to its magnitude, of noise and nonlinearity
    together; `spread_of_noise` is of noise alone. `coherence` (k,) is the fraction of the position's power at a line
    that repeats from period to period. `moved_um` is the largest distance of the position from its mean.
    """

    hz: Real
    plant: Complex
    controller: Complex
    spread: Real
    spread_of_noise: Real
    coherence: Real
    periods: int
    moved_um: float


def measure_response(grid: LineGrid, signals: PeriodSignals) -> MeasuredResponse:
    """Return the response from at least two periods. Raises ValueError for fewer, and if the mean of command, error or
    position is exactly 0 at one of the excited lines.
    """
    periods = len(signals.position)
    if periods < 2:
        raise ValueError(
            f"complete periods of the multisine in the recording: {periods}; allowed: at least 2. Record longer"
        )
    x, v, e = (grid.amplitudes(signal) for signal in (signals.position, signals.command, signals.error))
    direct = 0.0 if signals.direct is None else grid.amplitudes(signals.direct)
    mean_x, mean_v, mean_e = (signal.mean(axis=0) for signal in (x, v, e))
    if not (np.all(mean_v) and np.all(mean_e) and np.all(mean_x)):
        raise ValueError(
            "the loop does not respond: the excitation does not reach the command, the error or the position. Check "
            "that the loop is closed and not at a limit"
        )
    variance = (np.abs(x - mean_x) ** 2).sum(axis=0) / (periods - 1)
    noise = _smooth_power(variance / periods)
    total = np.maximum(_silent_line_power(grid, signals.position.mean(axis=0)), noise)
    plant, controller = mean_x / mean_v, (mean_v - direct) / mean_e
    factor = np.abs(1 + plant * controller) / np.abs(mean_x)
    power = np.abs(mean_x) ** 2
    deviation = signals.position - signals.position.mean()
    return MeasuredResponse(
        grid.hz,
        plant,
        controller,
        factor * np.sqrt(total),
        factor * np.sqrt(noise),
        power / (power + _smooth_power(variance)),
        periods,
        float(np.abs(deviation).max()),
    )


def _smooth_power(power: Real) -> Real:
    """Return `power` (lines,) averaged over up to nine neighbouring lines, as one line of few periods is uncertain."""
    kernel = np.ones(min(9, power.size))
    return np.convolve(power, kernel, "same") / np.convolve(np.ones_like(power), kernel, "same")


def _silent_line_power(grid: LineGrid, period: Real) -> Real:
    """Return the mean power of the silent lines that are nearest to each excited one, (excited,), for a period
    (samples,).
    """
    power = np.abs(np.fft.rfft(period)[grid.silent] * (2 / grid.samples)) ** 2
    summed = np.concatenate([[0.0], np.cumsum(power)])
    width = min(SILENT_NEARBY, power.size)
    first = np.clip(np.searchsorted(grid.silent, grid.excited) - width // 2, 0, power.size - width)
    return (summed[first + width] - summed[first]) / width

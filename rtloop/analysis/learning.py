"""Iterative learning of a periodic reference: a table of two columns, for the reference and for the command.

    x = T r + G w,   T from the reference with its taps,   G from the command      at each harmonic of the period
    [r, w] ← [r, w] + L (wanted − x),   the error of the next cycle: (1 − T L_r − G L_w) of this one's

Frequency-domain learning (Bristow, Tharayil and Alleyne, IEEE Control Systems 26(3), 2006): L is the regularised
least-squares inverse of [T, G] over all loops that the plant may make, and a harmonic is learned where it shrinks the
error in each of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtloop.analysis.closed_loop import Loop
from rtloop.foundation.arrays import Complex, Real

LARGEST_CONTRACTION = 0.8
"""Of a harmonic's error from one cycle to the next, in the worst of all loops, that is still learned."""
LEAST_RESPONSE = 0.1
"""Of the position to reference and command: of less, noise would be learned, and large commands for little."""

SETTLE_S, EVALUATION_S = 0.1, 0.2
"""Of a cycle at least so long, in whole periods, to settle and to be judged."""
MAX_ERROR_GROWTH = 1.1
"""An error larger by this factor than the least so far is not learned from: the table goes back to that one's."""


def cycle_periods(period_ticks: int, rate_hz: float) -> tuple[int, int]:
    """Of a cycle: how many to settle, and how many are judged."""
    period_s = period_ticks / rate_hz
    return math.ceil(SETTLE_S / period_s), math.ceil(EVALUATION_S / period_s)


def unlearned_table(wanted_um: Real) -> Real:
    """The table (period, 2) of which nothing is learned: it adds nothing to the command."""
    return np.column_stack([wanted_um, np.zeros_like(wanted_um)])


def rms(values: Real) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True, eq=False)
class LearningGains:
    """`gains` (harmonics, 2) from an error to both columns; `contraction` (harmonics,), the worst of all loops."""

    period_ticks: int
    gains: Complex
    contraction: Real

    @property
    def is_learned(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which harmonics, from 0 Hz on."""
        return self.contraction < LARGEST_CONTRACTION

    def improve(self, table: Real, error_um: Real) -> Real:
        """The table (period, 2) after a cycle that was wrong by `error_um` (period,), wanted minus measured."""
        change = (self.gains * self.is_learned[:, None]).T * np.fft.rfft(error_um)
        return table + np.fft.irfft(change, self.period_ticks).T


def learning_gains(loops: Sequence[tuple[str, Loop]], period_ticks: int) -> LearningGains:
    """How a table of so many ticks learns in named loops of one rate.

    Raises ValueError, which says why, where the error of the period itself would not shrink in each of them.
    """
    period_s = loops[0][1].period_s
    assert period_s is not None
    hz = np.arange(period_ticks // 2 + 1) / (period_ticks * period_s)
    unstable = [name for name, loop in loops if not loop.is_stable]
    if unstable:
        raise ValueError(f"{unstable[0]}: the loop is unstable there, and no table can be learned in it")
    paths = np.array([np.column_stack(_position_responses(loop, hz)) for _, loop in loops])
    gains = _regularised_inverse(paths)
    contractions = np.abs(1 - np.einsum("shc,hc->sh", paths, gains))
    result = LearningGains(period_ticks, gains, contractions.max(axis=0))
    if not result.is_learned[:2].all():
        harmonic = int(np.argmax(~result.is_learned[:2]))
        worst_loop = loops[int(np.argmax(contractions[:, harmonic]))][0]
        raise ValueError(
            f"{worst_loop}: a cycle leaves {result.contraction[harmonic]:.2f} of the error at {hz[harmonic]:g} Hz; "
            f"less than {LARGEST_CONTRACTION} is needed for it to shrink from one cycle to the next"
        )
    return result


def _position_responses(loop: Loop, hz: Real) -> tuple[Complex, Complex]:
    """To the position: from the reference, and from what is added to the command."""
    return loop.response_from_reference(hz)[0], loop.response_from_command(hz)


def _regularised_inverse(paths: Complex) -> Complex:
    """L (harmonics, 2) of least Σ |1 − [T, G] L|² over the loops of `paths` (loops, harmonics, 2)."""
    adjoint = np.conj(paths)
    normal = np.einsum("shi,shj->hij", adjoint, paths) + len(paths) * LEAST_RESPONSE**2 * np.eye(2)
    return np.linalg.solve(normal, adjoint.sum(axis=0)[..., None])[..., 0]

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
"""Largest factor from one cycle's error to the next, in the worst loop, at which a harmonic is still learned."""
LEAST_RESPONSE = 0.1
"""Least response of the position to reference and command. Below it, noise would be learned, and commands would be
large."""

SETTLE_S, EVALUATION_S = 0.1, 0.2
"""Least durations in s, rounded up to whole periods, to settle and to be evaluated in each cycle."""
MAX_ERROR_GROWTH = 1.1
"""Growth of the error over the least error so far beyond which a cycle is not learned from: the best table is taken
again."""


def cycle_periods(period_ticks: int, rate_hz: float) -> tuple[int, int]:
    """Return two numbers of periods in a learning cycle: those to settle first, and those to evaluate then.

    They are the least numbers that last SETTLE_S and EVALUATION_S.
    """
    period_s = period_ticks / rate_hz
    return math.ceil(SETTLE_S / period_s), math.ceil(EVALUATION_S / period_s)


def unlearned_table(wanted_um: Real) -> Real:
    """Return the table (period, 2) before learning: the wanted positions (period,), µm, and 0 added to the command."""
    return np.column_stack([wanted_um, np.zeros_like(wanted_um)])


def rms(values: Real) -> float:
    """Return the root mean square of `values`."""
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True, eq=False)
class LearningGains:
    """Gains of iterative learning for a periodic table of two columns: reference and addition to the command.

    `gains` (harmonics, 2) lead from an error to both columns. `contraction` (harmonics,) is the factor from one cycle's
    error to the next, in the worst of all loops.
    """

    period_ticks: int
    gains: Complex
    contraction: Real

    @property
    def is_learned(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Mask (harmonics,), from 0 Hz on: True where the contraction is below LARGEST_CONTRACTION, to be learned."""
        return self.contraction < LARGEST_CONTRACTION

    def improve(self, table: Real, error_um: Real) -> Real:
        """Return the table (period, 2), µm, of the next cycle, from `table` of a cycle and its `error_um` (period,).

        The columns are the reference and the addition to the command; the error is wanted minus measured position.
        Harmonics that are not learned stay as they are.
        """
        change = (self.gains * self.is_learned[:, None]).T * np.fft.rfft(error_um)
        return table + np.fft.irfft(change, self.period_ticks).T


def learning_gains(loops: Sequence[tuple[str, Loop]], period_ticks: int) -> LearningGains:
    """Return the learning gains for a table of `period_ticks`, for all named loops, of one rate, at once.

    Raises ValueError, with the name of the loop, where a loop is unstable or in continuous time, and where a cycle
    would leave LARGEST_CONTRACTION or more of the error at 0 Hz or at the first harmonic in any loop.
    """
    period_s = loops[0][1].period_s
    if period_s is None:
        raise ValueError(f"{loops[0][0]}: the loop is in continuous time; learning needs a sampled loop")
    hz = np.arange(period_ticks // 2 + 1) / (period_ticks * period_s)
    unstable = [name for name, loop in loops if not loop.is_stable]
    if unstable:
        raise ValueError(
            f"the loop is unstable with {unstable[0]}; learning needs a loop that is stable for the "
            "model and for every resonance within resonance_percent of the model's. Use a smaller "
            "resonance_percent, or another "
            "controller"
        )
    paths = np.array([np.column_stack(_position_responses(loop, hz)) for _, loop in loops])
    gains = _regularised_inverse(paths)
    contractions = np.abs(1 - np.einsum("shc,hc->sh", paths, gains))
    result = LearningGains(period_ticks, gains, contractions.max(axis=0))
    if not result.is_learned[:2].all():
        harmonic = int(np.argmax(~result.is_learned[:2]))
        worst_loop = loops[int(np.argmax(contractions[:, harmonic]))][0]
        raise ValueError(
            f"learning converges too slowly, or not at all, with {worst_loop}: one cycle multiplies the error at "
            f"{hz[harmonic]:g} Hz by {result.contraction[harmonic]:.2f}; allowed: below {LARGEST_CONTRACTION}. Use a "
            "smaller resonance_percent, or a reference with another period"
        )
    return result


def _position_responses(loop: Loop, hz: Real) -> tuple[Complex, Complex]:
    """Return the complex responses (k,) to the position at frequencies `hz` (k,), from the reference, which passes the
    pre-filter, and from a signal added to the command.
    """
    return loop.response_from_reference(hz)[0], loop.response_from_command(hz)


def _regularised_inverse(paths: Complex) -> Complex:
    """Return L (harmonics, 2) with least Σ |1 − [T, G] L|² over all loops, regularised by LEAST_RESPONSE.

    `paths` (loops, harmonics, 2) has T and G, the responses from the reference and from the command to the position.
    """
    adjoint = np.conj(paths)
    normal = np.einsum("shi,shj->hij", adjoint, paths) + len(paths) * LEAST_RESPONSE**2 * np.eye(2)
    return np.linalg.solve(normal, adjoint.sum(axis=0)[..., None])[..., 0]

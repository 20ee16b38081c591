"""Multisines of odd harmonics: periodic, of low crest factor, and silent at lines that show nonlinearity.

    r_k = Σ A_l cos(2π l k/N + φ_l)        l odd, some of them left out

A static nonlinearity answers at lines that are not excited as well; noise is there too. The silent lines nearby
therefore show the uncertainty at an excited line (Pintelon & Schoukens, System
Identification, 2012, chapter 4). The crest factor is lowered by clipping in time and keeping the amplitudes in
frequency (Van der Ouderaa, Schoukens & Renneboog 1988).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Complex, Real

Lines = npt.NDArray[np.int64]
PER_DECADE = 100
DENSE_BAND = 0.12
"""Half width, as a fraction of a resonance's frequency, of the band in which every odd line is a candidate."""
SILENT_INTERVAL = 4
"""Number of successive odd lines of which one stays silent."""
FLATTENINGS, CLIPPING_RATIO = 60, 0.85
FADE_IN_PART = 0.5
"""Fraction of the settling period during which the reference grows."""
HIGHEST_PART = 0.45
"""Highest excited frequency as a fraction of the rate."""


@dataclass(frozen=True)
class LineGrid:
    """A period of `samples` at `rate_hz`; `excited` and `silent` are numbers of harmonics, each rising."""

    samples: int
    rate_hz: float
    excited: Lines
    silent: Lines

    @property
    def hz(self) -> Real:
        """Frequencies in Hz of the excited lines, (excited,), rising."""
        return self.excited * self.rate_hz / self.samples

    def waveform(self, amplitudes: Complex) -> Real:
        """Return one period (samples,) with complex `amplitudes` (excited,), of peak values, at the excited lines."""
        spectrum = np.zeros(self.samples // 2 + 1, complex)
        spectrum[self.excited] = amplitudes * self.samples / 2
        return np.fft.irfft(spectrum, self.samples)

    def amplitudes(self, period: Real) -> Complex:
        """Return complex amplitudes (…, excited) at the excited lines, of periods (…, samples)."""
        return np.fft.rfft(period)[..., self.excited] * (2 / self.samples)


def make_grid(
    rate_hz: float, period_s: float, from_hz: float, to_hz: float, near_hz: float | None = None, seed: int = 0
) -> LineGrid:
    """Return odd lines between two frequencies, evenly on a logarithmic scale, dense about `near_hz`.

    The period is rounded to whole samples. In a run of successive odd lines, one of SILENT_INTERVAL stays silent,
    chosen at random by `seed`. `silent` has all harmonics, even ones too, that are not excited, from one below the
    lowest odd line of the band to one above the highest. Raises ValueError for fewer than three odd lines in the band,
    and unless 0 < `from_hz` < `to_hz` ≤ HIGHEST_PART of the rate.
    """
    samples = round(period_s * rate_hz)
    if not 0 < from_hz < to_hz <= HIGHEST_PART * rate_hz:
        raise ValueError(
            f"from_hz = {from_hz:g} and to_hz = {to_hz:g}; allowed: 0 < from_hz < to_hz ≤ {HIGHEST_PART * rate_hz:g} Hz"
        )
    first, last = (hz * samples / rate_hz for hz in (from_hz, to_hz))
    odd = np.arange(2 * int(np.ceil((first - 1) / 2)) + 1, np.floor(last) + 1, 2, dtype=np.int64)
    if odd.size < 3:
        raise ValueError(
            f"the band from {from_hz:g} to {to_hz:g} Hz contains {odd.size} odd multiples of "
            f"{rate_hz / max(samples, 1):g} Hz (1/period_s); allowed: at least 3. Use a wider band or a longer period_s"
        )
    decades = np.log10(odd[-1] / odd[0])
    targets = np.geomspace(odd[0], odd[-1], max(2, round(PER_DECADE * decades)))
    candidates = np.unique(odd[np.abs(odd[:, None] - targets[None, :]).argmin(axis=0)])
    if near_hz is not None:
        line = near_hz * samples / rate_hz
        candidates = np.union1d(candidates, odd[np.abs(odd - line) <= DENSE_BAND * line])
    silent_candidates = _choose_silent(candidates, np.random.default_rng(seed))
    excited = np.setdiff1d(candidates, silent_candidates)
    silent = np.setdiff1d(np.arange(max(1, odd[0] - 1), odd[-1] + 2), excited)
    return LineGrid(samples, rate_hz, excited, silent)


def _choose_silent(candidates: Lines, random: np.random.Generator) -> Lines:
    """Return the candidates that stay silent: in each run of successive odd lines, one at random of SILENT_INTERVAL.

    The ends of a run are never silent.
    """
    runs = np.split(candidates, np.flatnonzero(np.diff(candidates) > 2) + 1)
    groups = [
        run[i : i + SILENT_INTERVAL] for run in runs for i in range(1, run.size - SILENT_INTERVAL, SILENT_INTERVAL)
    ]
    return np.array([random.choice(group) for group in groups], dtype=np.int64)


def low_crest_amplitudes(grid: LineGrid, sizes: Real, seed: int = 0) -> Complex:
    """Return complex amplitudes (excited,) of magnitudes `sizes`, with phases that keep the waveform's peak low.

    Phases begin at random by `seed`; the lowest peak of FLATTENINGS rounds counts.
    """
    phases: Complex = np.exp(2j * np.pi * np.random.default_rng(seed).random(sizes.size))
    lowest_crest, lowest_peak = sizes * phases, np.inf
    for _ in range(FLATTENINGS):
        wave = grid.waveform(sizes * phases)
        peak = float(np.abs(wave).max())
        if peak < lowest_peak:
            lowest_crest, lowest_peak = sizes * phases, peak
        clipped = grid.amplitudes(np.clip(wave, -CLIPPING_RATIO * peak, CLIPPING_RATIO * peak))
        phases = np.exp(1j * np.angle(clipped))
    return lowest_crest


def excitation_sequence(period: Real, periods: int, hold: float, fade_ticks: int) -> Real:
    """Return a reference (ticks,): `hold` plus a settling `period` that begins gently, `periods` whole ones, and a fade
    back to `hold` in `fade_ticks`.

    The last sample is `hold`, where the reference stays after the sequence.
    """
    rising = 0.5 - 0.5 * np.cos(np.pi * np.minimum(np.arange(period.size) / (FADE_IN_PART * period.size), 1.0))
    falling = (0.5 + 0.5 * np.cos(np.pi * np.arange(1, fade_ticks + 1) / fade_ticks)) * np.resize(period, fade_ticks)
    return hold + np.concatenate([rising * period, np.tile(period, periods), falling])

"""Power spectral density from near DC to half the rate, averaged while samples arrive: a cascade of short transforms.

Stage s averages periodograms (Hann window, 50 % overlap; Welch 1967) of SEGMENT samples at the rate
f/DECIMATION^s, and passes its samples, low-pass filtered and decimated, to stage s + 1. Each frequency is taken from
the last stage that resolves it, so that the resolution is some percent of the frequency everywhere, high frequencies
appear at once, and the work for each sample is bounded. As in QUARTIQ's stabilizer-stream (Jördens) and in LPSD (Tröbs
and Heinzel 2006, doi:10.1016/j.measurement.2005.10.010).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.panel.spectrum.even_grid import EvenGrid

SEGMENT = 1024
DECIMATION = 4
PASSBAND_RATIO = 0.4
"""A decimated stage is exact up to this part of its rate; higher frequencies alias to above it."""
ATTENUATION_DB = 100.0
"""Attenuation of frequencies that would alias to below PASSBAND_RATIO."""
LOWEST_BIN = 2
"""First bin without the mean; the Hann window spreads a constant over bins 0 and 1."""
MAX_BRIDGED = SEGMENT // 100
"""Longest hole, in samples, that a straight line bridges."""
BLOCK_SAMPLES = 1 << 16
"""Samples that are processed together, so that a long record needs little memory."""
FINER_UNITS = {"µm": ("nm", 1e3)}


class Power(NamedTuple):
    """Power of one stage of the cascade below each edge of its frequency bins.

    `below` (edges,) is that power, in the density's unit squared, `edges_hz` (edges,) the edges, ascending.
    """

    edges_hz: Real
    below: Real


class Density(NamedTuple):
    """Amplitude density, one-sided, over contiguous bands; band i reaches from `edges_hz[i]` to `edges_hz[i + 1]`."""

    hz: Real
    """(bands,): centre of each band, ascending."""
    edges_hz: Real
    """(bands + 1,): edges of the bands, ascending."""
    amplitude: Real
    """(bands,): amplitude density in `unit`/√Hz."""
    averages: npt.NDArray[np.intp]
    """(bands,): number of averaged periodograms."""
    unit: str
    powers: tuple[Power, ...]
    """Contribution of each stage to the total power."""

    def rms(self, low_hz: float, high_hz: float) -> float:
        """Return the rms between two frequencies, in `unit`; 0 unless `low_hz` is below `high_hz`.

        Frequencies outside the density contribute 0.
        Where two stages overlap, one is blended into the other over an octave; else a line at a change of the band
        width would count too much or too little.
        """
        if not low_hz < high_hz:
            return 0.0
        band_powers = [np.interp([low_hz, high_hz], power.edges_hz, power.below) for power in self.powers]
        return float(np.sqrt(max(sum(high_power - low_power for low_power, high_power in band_powers), 0.0)))


class Spectrum:
    """Spectrum of a signal in `unit`, sampled at `rate_hz` > 0 (else ValueError); µm become nm.

    `segment` is the number of samples of a periodogram.
    """

    def __init__(self, rate_hz: float, unit: str, segment: int = SEGMENT) -> None:
        """Begin without averages; `unit` µm becomes nm. Raises ValueError unless `rate_hz` is above 0."""
        if not rate_hz > 0:
            raise ValueError(f"spectrum: a rate of {rate_hz:g} Hz; allowed: above 0")
        self._rate_hz, self._segment = rate_hz, segment
        self._unit, self._scale = FINER_UNITS.get(unit, (unit, 1.0))
        self.reset()

    def reset(self) -> None:
        """Discard all averages, and the samples that wait for their segment."""
        self._grid = EvenGrid(MAX_BRIDGED)
        self._stages: list[_Stage] = []

    @property
    def bridged_count(self) -> int:
        """Missing samples since the last reset that a straight line replaced."""
        return self._grid.bridged_count

    def feed(self, values: Real, periods: Real) -> None:
        """Average samples (n,); `periods` (n,) are the numbers of their periods, as `Stretch.periods` gives them.

        Periods without a finite sample are a hole: up to MAX_BRIDGED are bridged; after a longer one segments and
        filters start again.
        """
        for start in range(0, len(values), BLOCK_SAMPLES):
            block = slice(start, start + BLOCK_SAMPLES)
            for is_continuation, samples in self._grid.add(values[block], periods[block]):
                if not is_continuation:
                    for stage in self._stages:
                        stage.restart()
                self._feed_stages(samples)

    def density(self, min_averages: int = 1) -> Density:
        """Return the density of all stages with at least `min_averages` averages, or at least one if that is less.

        Without such a stage the density has no bands: `edges_hz` is (1,), all other arrays are empty, and every rms is
        0.
        """
        stages = [stage for stage in self._stages if stage.averages >= max(min_averages, 1)]
        hz, edges, amplitude, averages, powers = [], [np.array([self._rate_hz / 2])], [], [], []
        for number, stage in enumerate(stages):
            rate_hz, is_deepest = self._rate_hz / DECIMATION**number, number == len(stages) - 1
            width_hz, bins = rate_hz / self._segment, np.arange(self._segment // 2 + 1)
            density = stage.density / rate_hz * self._scale**2
            lowest_bin = LOWEST_BIN if is_deepest else int(PASSBAND_RATIO * self._segment / DECIMATION)
            selected = (bins >= lowest_bin) & ((bins - 0.5) * width_hz < edges[-1][0])
            hz.append(bins[selected] * width_hz)
            edges.append((bins[selected] - 0.5) * width_hz)
            amplitude.append(np.sqrt(density[selected]))
            averages.append(np.full(np.count_nonzero(selected), stage.averages))
            share = (bins >= LOWEST_BIN).astype(float)
            if not is_deepest:
                share = _blend_weight(bins / self._segment * DECIMATION)
            if number:
                share -= _blend_weight(bins / self._segment)
            upper_edges = np.minimum(np.append(bins - 0.5, bins[-1]), bins[-1]) * width_hz
            power = np.cumsum(share * density * np.diff(upper_edges))
            powers.append(Power(upper_edges, np.concatenate([[0.0], power])))
        if not stages:
            return Density(np.zeros(0), edges[0], np.zeros(0), np.zeros(0, np.intp), self._unit, ())
        columns = (np.concatenate(parts[::-1]) for parts in (hz, edges, amplitude, averages))
        return Density(*columns, unit=self._unit, powers=tuple(powers))

    def _feed_stages(self, samples: Real) -> None:
        """Feed evenly spaced samples (n,) to the first stage, and each stage's samples, decimated, to the next one.

        The rate falls by DECIMATION from stage to stage. Adds stages as needed.
        """
        number = 0
        while samples.size:
            if number == len(self._stages):
                self._stages.append(_Stage(self._segment))
            samples = self._stages[number].feed(samples)
            number += 1


class _Stage:
    """A stage of the cascade: averages periodograms and decimates its samples."""

    def __init__(self, segment: int) -> None:
        """Begin without averages; `segment` is the number of samples of a periodogram."""
        self._segment = segment
        self._window = np.sin(np.pi / segment * np.arange(segment)) ** 2
        self._power = np.zeros(segment // 2 + 1)
        self.averages = 0
        self.restart()

    def restart(self) -> None:
        """Begin new segments and filters after a hole; the averages stay."""
        self._pending = self._unfiltered = np.zeros(0)

    @property
    def density(self) -> Real:
        """Mean power density (segment/2 + 1,), one-sided, for a sampling rate of 1; needs `averages` ≥ 1.

        The last bin has half the others' width.
        """
        return 2 * self._power / (self.averages * np.sum(self._window**2))

    def feed(self, samples: Real) -> Real:
        """Average samples (n,), n ≥ 1, and return the decimated ones (m,), m ≥ 0, which begin at the first sample.

        Before the first sample the filter sees that sample held: the window hardly weighs this start, and the segments
        of all stages begin together.
        """
        self._average(samples)
        if self._unfiltered.size == 0:
            self._unfiltered = np.full(TAPS.size // 2, samples[0])
        self._unfiltered = np.concatenate([self._unfiltered, samples])
        count = 1 + (self._unfiltered.size - TAPS.size) // DECIMATION
        if count < 1:
            return np.zeros(0)
        decimated = np.convolve(self._unfiltered, TAPS, "valid")[::DECIMATION]
        self._unfiltered = self._unfiltered[count * DECIMATION :].copy()
        return decimated

    def _average(self, samples: Real) -> None:
        """Add the periodograms of all complete segments, which overlap by half, to the averages; the rest waits."""
        step, segment = self._segment // 2, self._segment
        pending = np.concatenate([self._pending, samples])
        count = 1 + (pending.size - segment) // step
        if count >= 1:
            segments = np.lib.stride_tricks.sliding_window_view(pending, segment)[::step]
            self._power += np.sum(np.abs(np.fft.rfft(segments * self._window)) ** 2, axis=0)
            self.averages += count
            pending = pending[count * step :].copy()
        self._pending = pending


def _blend_weight(frequency_ratio: Real) -> Real:
    """Return the weight of a stage's power at frequencies that the next stage, of lower rate, also resolves.

    `frequency_ratio` is the frequency divided by the next stage's rate. The weight is 0 up to half of PASSBAND_RATIO,
    grows linearly, and is 1 from PASSBAND_RATIO on.
    """
    return np.clip(2 * frequency_ratio / PASSBAND_RATIO - 1, 0.0, 1.0)


def _low_pass() -> Real:
    """Return the taps of a low-pass by Kaiser's window (Kaiser 1974), with unit gain at DC.

    The transition is from PASSBAND_RATIO to 1 − PASSBAND_RATIO of the decimated rate.
    """
    transition = 2 * np.pi * (1 - 2 * PASSBAND_RATIO) / DECIMATION
    half = int(np.ceil((ATTENUATION_DB - 7.95) / (2.285 * transition) / 2))
    beta = 0.1102 * (ATTENUATION_DB - 8.7)
    taps = np.sinc(np.arange(-half, half + 1) / DECIMATION) * np.kaiser(2 * half + 1, beta)
    return taps / taps.sum()


TAPS = _low_pass()

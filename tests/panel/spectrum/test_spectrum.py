"""The cascaded spectrum agrees with scipy's Welch on the same samples, and with lines and noise of known power."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from rtloop.panel.spectrum.spectrum import MAX_BRIDGED, Density, Spectrum

SEGMENT, FACTOR = 1024, 4
COUNT = (1 << 20) + 3000
"""Samples of a noise; no stage's last segment ends with them, for the filters before it need later samples."""


def measure_density(samples: np.ndarray, rate_hz: float, block: int = 4096, min_averages: int = 1) -> Density:
    """Return the density of samples in µm, fed in blocks; only bands with at least `min_averages` periodograms."""
    spectrum = Spectrum(rate_hz, "µm")
    for start in range(0, len(samples), block):
        part = samples[start : start + block]
        spectrum.feed(part, np.arange(start, start + len(part), dtype=float))
    return spectrum.density(min_averages)


def white_noise_um(seed: int) -> np.ndarray:
    """Return COUNT samples of white noise of 1 nm rms, in µm."""
    return 0.001 * np.random.default_rng(seed).standard_normal(COUNT)


NOISES = {
    "white": lambda: white_noise_um(1),
    "first order": lambda: signal.lfilter([1.0], [1.0, -0.995], white_noise_um(2)),
    "resonant": lambda: signal.lfilter([1.0], [1.0, -1.9, 0.97], white_noise_um(3)) + 12.5,
    "first differences": lambda: signal.lfilter([1.0, -1.0], [1.0], white_noise_um(4)),
}


@pytest.mark.parametrize(("noise", "rate_hz"), [("white", 10e3), ("white", 2e3), ("first order", 10e3),
                                                ("resonant", 4e3), ("first differences", 50e3)])  # fmt: skip
def test_within_a_hundredth_of_a_decibel_of_welch(noise: str, rate_hz: float):
    """Each band agrees with Welch's periodograms of the same resolution, where both average more than 100."""
    samples = NOISES[noise]()
    density = measure_density(samples, rate_hz, min_averages=101)
    assert density.hz[0] == rate_hz / 8192
    for stage, averages in enumerate(sorted(set(density.averages), reverse=True)):
        length = SEGMENT * FACTOR**stage
        assert 2 * COUNT // length - 1 == averages
        hz, power = signal.welch(samples, rate_hz, "hann", length)
        bands = (density.averages == averages) & (density.hz < rate_hz / 2)  # the last band is only half a bin wide
        bins = np.rint(density.hz[bands] * length / rate_hz).astype(int)
        np.testing.assert_allclose(hz[bins], density.hz[bands])
        decibels = 20 * np.log10(density.amplitude[bands] / 1e3) - 10 * np.log10(power[bins])
        assert np.max(np.abs(decibels)) < 0.01, stage


def test_a_sine_of_50_nm_at_100_hz_is_35_4_nm_rms():
    """20 s of the sine with noise of 1 nm, a position of 12.5 µm and a slow drift."""
    time_s = np.arange(200_000) / 10e3
    samples = 12.5 + 0.05 * np.sin(2 * np.pi * 100.0 * time_s + 1.0) + white_noise_um(5)[:200_000] + 0.001 * time_s
    density = measure_density(samples, 10e3)
    assert density.unit == "nm"
    assert density.rms(80.0, 120.0) == pytest.approx(50 / np.sqrt(2), rel=0.01)
    assert density.rms(120.0, 1000.0) < 1.0


@pytest.mark.parametrize("hz", [20.0, 62.3, 4900.0, *np.linspace(490.0, 1010.0, 27).tolist()])
def test_a_line_counts_once_wherever_it_lies(hz: float):
    """The power is right also from 500 Hz to 1000 Hz, where one stage fades into the next, and where bands widen."""
    density = measure_density(np.sin(2 * np.pi * hz / 10e3 * np.arange(100_000)), 10e3, 65536)
    assert density.rms(hz / 2, min(1.5 * hz, 5000.0)) == pytest.approx(1e3 / np.sqrt(2), rel=0.01)


def test_the_whole_is_the_power_of_the_noise():
    """The bands are contiguous from below 0.1 Hz to half the rate, with more averages at higher frequencies."""
    density = measure_density(white_noise_um(6), 10e3)
    assert density.rms(0.0, 5000.0) == pytest.approx(1.0, rel=0.01)
    assert np.all(np.diff(density.edges_hz) > 0)
    assert density.edges_hz[-1] == 5000.0
    assert density.edges_hz[0] < 0.1
    assert np.all(np.diff(density.averages) >= 0)
    rms_of_bands = np.sqrt(np.sum(density.amplitude**2 * np.diff(density.edges_hz)))
    assert rms_of_bands == pytest.approx(1.0, rel=0.01)


def test_aliases_are_suppressed():
    """A line of 1 µm above half the rate of a stage appears at least 90 dB weaker below that frequency."""
    density = measure_density(np.sin(2 * np.pi * 2490.0 / 10e3 * np.arange(300_000)), 10e3)
    assert density.rms(1.0, 900.0) < 1e3 * 10 ** (-90 / 20)


@given(st.lists(st.integers(1, 3000), max_size=10))
@settings(max_examples=20)
def test_the_spectrum_does_not_depend_on_the_lengths_of_blocks(lengths: list[int]):
    samples = white_noise_um(7)[:20_000]
    in_one_block, in_pieces = Spectrum(1e4, "V", 64), Spectrum(1e4, "V", 64)
    periods = np.arange(len(samples), dtype=float)
    in_one_block.feed(samples, periods)
    for part in np.split(np.arange(len(samples)), np.cumsum(lengths)):
        in_pieces.feed(samples[part], periods[part])
    expected, density = in_one_block.density(), in_pieces.density()
    np.testing.assert_array_equal(expected.averages, density.averages)
    np.testing.assert_allclose(expected.amplitude, density.amplitude, rtol=1e-9)
    assert expected.unit == "V"


def test_short_holes_are_bridged_and_long_ones_break_the_record():
    """A ramp stays a ramp over missed periods and NaN samples. After a lost second a new segment begins; the averages
    from before stay.
    """
    spectrum, periods = Spectrum(1e3, "µm", 64), np.arange(10_000.0)
    ramp = 0.01 * periods
    is_present = np.ones(len(periods), bool)
    is_present[[100, 101, 2000, 4095, 4096]] = False
    ramp[3000:3005] = np.nan
    spectrum.feed(ramp[:4096][is_present[:4096]], periods[:4096][is_present[:4096]])
    spectrum.feed(ramp[4096:][is_present[4096:]], periods[4096:][is_present[4096:]])
    complete = Spectrum(1e3, "µm", 64)
    complete.feed(0.01 * periods, periods)
    assert spectrum.bridged_count == 10
    np.testing.assert_allclose(spectrum.density().amplitude, complete.density().amplitude, atol=1e-9)
    before = spectrum.density().averages
    spectrum.feed(np.full(63, 1e6), 11_000 + np.arange(63.0))
    np.testing.assert_array_equal(spectrum.density().averages, before)
    assert spectrum.bridged_count == 10
    spectrum.feed(np.full(1, 1e6), np.array([11_063.0]))
    assert spectrum.density().averages[-1] == before[-1] + 1
    np.testing.assert_allclose(
        spectrum.density().amplitude[-20:-1],
        complete.density().amplitude[-20:-1] * np.sqrt(before[-1] / (before[-1] + 1)),
    )


@pytest.mark.parametrize(("hole", "averages"), [(MAX_BRIDGED, 3), (MAX_BRIDGED + 1, 2)])
def test_the_longest_hole_that_is_bridged(hole: int, averages: int):
    spectrum = Spectrum(1e3, "µm", 64)
    for first in (0, 64 + hole):
        spectrum.feed(np.ones(64), first + np.arange(64.0))
    assert spectrum.density().averages[-1] == averages
    assert spectrum.bridged_count == (hole if averages == 3 else 0)


def test_a_spectrum_is_empty_at_first_and_after_a_reset():
    spectrum = Spectrum(1e3, "µm")
    empty = spectrum.density()
    assert (empty.hz.size, empty.rms(0.0, 500.0)) == (0, 0.0)
    spectrum.feed(np.ones(4096), np.arange(4096.0))
    assert spectrum.density().averages[-1] == 7
    assert spectrum.density(min_averages=8).hz.size == 0
    assert spectrum.density().rms(10.0, 5.0) == 0.0
    spectrum.reset()
    assert spectrum.density().hz.size == 0
    with pytest.raises(ValueError, match="rate of -5 Hz"):
        Spectrum(-5.0, "µm")

"""The cascaded spectrum against scipy's Welch on the same samples, and against lines and noise of known power."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from rtloop.panel.spectrum.spectrum import MAX_BRIDGED, Density, Spectrum

SEGMENT, FACTOR = 1024, 4
COUNT = (1 << 20) + 3000
"""So that no stage's last segment ends with the samples: the filters in front of it must have seen beyond it."""


def measured(samples: np.ndarray, rate_hz: float, block: int = 4096, least: int = 1) -> Density:
    spectrum = Spectrum(rate_hz, "µm")
    for start in range(0, len(samples), block):
        part = samples[start : start + block]
        spectrum.feed(part, np.arange(start, start + len(part), dtype=float))
    return spectrum.density(least)


def white(seed: int) -> np.ndarray:
    return 0.001 * np.random.default_rng(seed).standard_normal(COUNT)


NOISES = {
    "white": lambda: white(1),
    "first order": lambda: signal.lfilter([1.0], [1.0, -0.995], white(2)),
    "resonant": lambda: signal.lfilter([1.0], [1.0, -1.9, 0.97], white(3)) + 12.5,
    "first differences": lambda: signal.lfilter([1.0, -1.0], [1.0], white(4)),
}


@pytest.mark.parametrize(("noise", "rate_hz"), [("white", 10e3), ("white", 2e3), ("first order", 10e3),
                                                ("resonant", 4e3), ("first differences", 50e3)])  # fmt: skip
def test_within_a_hundredth_of_a_decibel_of_welch(noise: str, rate_hz: float):
    """Every band, each from Welch's periodograms of the same resolution, where both average more than 100."""
    samples = NOISES[noise]()
    found = measured(samples, rate_hz, least=101)
    assert found.hz[0] == rate_hz / 8192
    for stage, averages in enumerate(sorted(set(found.averages), reverse=True)):
        length = SEGMENT * FACTOR**stage
        assert 2 * COUNT // length - 1 == averages
        hz, power = signal.welch(samples, rate_hz, "hann", length)
        ours = (found.averages == averages) & (found.hz < rate_hz / 2)  # the last bin of all: one side of it is there
        bins = np.rint(found.hz[ours] * length / rate_hz).astype(int)
        np.testing.assert_allclose(hz[bins], found.hz[ours])
        decibels = 20 * np.log10(found.amplitude[ours] / 1e3) - 10 * np.log10(power[bins])
        assert np.max(np.abs(decibels)) < 0.01, stage


def test_a_sine_of_50_nm_at_100_hz_is_35_4_nm_rms():
    """Beside noise of 1 nm, a position of 12.5 µm and a slow drift, after 20 s."""
    time_s = np.arange(200_000) / 10e3
    samples = 12.5 + 0.05 * np.sin(2 * np.pi * 100.0 * time_s + 1.0) + white(5)[:200_000] + 0.001 * time_s
    found = measured(samples, 10e3)
    assert found.unit == "nm"
    assert found.rms(80.0, 120.0) == pytest.approx(50 / np.sqrt(2), rel=0.01)
    assert found.rms(120.0, 1000.0) < 1.0


@pytest.mark.parametrize("hz", [20.0, 62.3, 4900.0, *np.linspace(490.0, 1010.0, 27).tolist()])
def test_a_line_counts_once_wherever_it_lies(hz: float):
    """Also where one stage gives way to the next, 500 Hz … 1000 Hz, and where the bands change their width."""
    found = measured(np.sin(2 * np.pi * hz / 10e3 * np.arange(100_000)), 10e3, 65536)
    assert found.rms(hz / 2, min(1.5 * hz, 5000.0)) == pytest.approx(1e3 / np.sqrt(2), rel=0.01)


def test_the_whole_is_the_power_of_the_noise():
    """From the lowest band to half the rate, of bands that touch and that grow with the frequency."""
    found = measured(white(6), 10e3)
    assert found.rms(0.0, 5000.0) == pytest.approx(1.0, rel=0.01)
    assert np.all(np.diff(found.edges_hz) > 0)
    assert found.edges_hz[-1] == 5000.0
    assert found.edges_hz[0] < 0.1
    assert np.all(np.diff(found.averages) >= 0)
    summed = np.sqrt(np.sum(found.amplitude**2 * np.diff(found.edges_hz)))
    assert summed == pytest.approx(1.0, rel=0.01)


def test_aliases_are_suppressed():
    """A line of 1 µm above a stage's half rate leaves nothing below that: the floor is the rounding of numbers."""
    found = measured(np.sin(2 * np.pi * 2490.0 / 10e3 * np.arange(300_000)), 10e3)
    assert found.rms(1.0, 900.0) < 1e3 * 10 ** (-90 / 20)


@given(st.lists(st.integers(1, 3000), max_size=10))
@settings(max_examples=20)
def test_the_spectrum_does_not_depend_on_the_lengths_of_blocks(lengths: list[int]):
    samples = white(7)[:20_000]
    whole, pieces = Spectrum(1e4, "V", 64), Spectrum(1e4, "V", 64)
    periods = np.arange(len(samples), dtype=float)
    whole.feed(samples, periods)
    for part in np.split(np.arange(len(samples)), np.cumsum(lengths)):
        pieces.feed(samples[part], periods[part])
    one, other = whole.density(), pieces.density()
    np.testing.assert_array_equal(one.averages, other.averages)
    np.testing.assert_allclose(one.amplitude, other.amplitude, rtol=1e-9)
    assert one.unit == "V"


def test_short_holes_are_bridged_and_long_ones_break_the_record():
    """A ramp through missed periods and samples that are no number stays a ramp; over a second that is lost, nothing
    is averaged, and what was averaged before stays.
    """
    spectrum, periods = Spectrum(1e3, "µm", 64), np.arange(10_000.0)
    ramp = 0.01 * periods
    there = np.ones(len(periods), bool)
    there[[100, 101, 2000, 4095, 4096]] = False
    ramp[3000:3005] = np.nan
    spectrum.feed(ramp[:4096][there[:4096]], periods[:4096][there[:4096]])
    spectrum.feed(ramp[4096:][there[4096:]], periods[4096:][there[4096:]])
    whole = Spectrum(1e3, "µm", 64)
    whole.feed(0.01 * periods, periods)
    assert spectrum.bridged_count == 10
    np.testing.assert_allclose(spectrum.density().amplitude, whole.density().amplitude, atol=1e-9)
    before = spectrum.density().averages
    spectrum.feed(np.full(63, 1e6), 11_000 + np.arange(63.0))
    np.testing.assert_array_equal(spectrum.density().averages, before)
    assert spectrum.bridged_count == 10
    spectrum.feed(np.full(1, 1e6), np.array([11_063.0]))
    assert spectrum.density().averages[-1] == before[-1] + 1
    np.testing.assert_allclose(
        spectrum.density().amplitude[-20:-1], whole.density().amplitude[-20:-1] * np.sqrt(before[-1] / (before[-1] + 1))
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

"""Noise, sensor, converters and latency against arithmetic written out here."""

from __future__ import annotations

from fractions import Fraction
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtloop.foundation.native.compiled import jit
from rtloop.hil.options import ConverterOptions, DynamicsOptions, PlantOptions, RigOptions, SensorOptions
from rtloop.hil.rig import build_rig
from rtloop.hil.stages.converters import lsb_and_range, quantise
from rtloop.hil.stages.noise import draw_normal, seed_word
from tests.hil.xorshift import xorshift64

RIGID = DynamicsOptions(form="zpk", gain=1.0)


@jit
def _draws(word, out):
    """Fill `out` with numbers of the stream that begins at `word`."""
    for i in range(out.size):
        out[i], word = draw_normal(word)


def draws(seed: int, stream: str, count: int) -> np.ndarray:
    """Return the first `count` numbers of a stream of noise."""
    out = np.empty(count)
    _draws(np.uint64(seed_word(seed, stream)), out)
    return out


def expected_draws(word: int, count: int) -> list[float]:
    """Return numbers by definition: sums of twelve 16-bit fields of three states of xorshift64, standardised."""
    sums = [sum(word >> shift & 0xFFFF for shift in (0, 16, 32, 48)) for word in islice(xorshift64(word), 3 * count)]
    return [(sum(sums[i : i + 3]) - 393210) / float(np.sqrt(2.0**32 - 1)) for i in range(0, 3 * count, 3)]


def test_noise_is_the_documented_generator():
    assert list(draws(7, "x", 200)) == expected_draws(seed_word(7, "x"), 200)


def test_noise_moments():
    """Irwin-Hall of 12: mean 0, variance 1, skewness 0, excess kurtosis −6/(5·12) = −0.1; bounds are 5 deviations."""
    values = draws(0, "x", 1_000_000)
    assert abs(values.mean()) < 5e-3
    assert abs(values.var() - 1) < 7e-3
    assert abs((values**3).mean()) < 1.2e-2
    assert abs((values**4).mean() / values.var() ** 2 - 2.9) < 5e-2
    assert np.abs(values).max() <= 6
    # P(|z| > 2) of the Irwin-Hall sum differs from the Gaussian's 0.0455 by less than 0.002.
    assert (np.abs(values) > 2).mean() == pytest.approx(0.0455, abs=2e-3)


def test_noise_is_white():
    values = draws(0, "x", 1_000_000)
    for lag in (1, 2, 3, 7, 64):
        assert abs((values[lag:] * values[:-lag]).mean()) < 5e-3


def test_streams_do_not_depend_on_each_other():
    assert abs(np.corrcoef(*(draws(0, name, 200_000) for name in "xy"))[0, 1]) < 0.012
    assert len({seed_word(seed, name) for seed in range(50) for name in "xy"}) == 100


def test_seed_changes_samples_and_nothing_else_does(run):
    first, same_seed, other_seed = (run(np.zeros(100), RigOptions(seed=seed)).adc_v.tobytes() for seed in (1, 1, 2))
    assert first == same_seed != other_seed


def test_an_axis_keeps_its_noise_beside_others():
    single, pair = (build_rig(RigOptions(), axes, 1e-4)[1] for axes in (["y"], ["x", "y"]))
    assert single[0].noise_word == pair[1].noise_word != pair[0].noise_word


def test_sensor_noise_has_the_configured_rms(run, ideal):
    sensor = SensorOptions(um_per_v=10.0, noise_um=0.5, resolution_um=0.0, offset_um=3.0)
    reading_um = 10 * run(np.zeros(100_000), ideal(sensor=sensor)).adc_v
    assert reading_um.std() == pytest.approx(0.5, rel=0.02)
    assert reading_um.mean() == pytest.approx(3.0, abs=0.01)


def test_sensor_resolution_and_scale(run, ideal):
    """1.26 µm + 0.5 µm at a resolution of 0.25 µm and 10 µm/V: 1.75 µm, 0.175 V."""
    sensor = SensorOptions(um_per_v=10.0, noise_um=0.0, resolution_um=0.25, offset_um=0.5)
    signals = run([1.26, 1.26], ideal(sensor=sensor, dynamics=RIGID))
    assert signals.true_um[1] == 1.26
    assert signals.adc_v[1] == 0.175


@pytest.mark.parametrize(
    ("value", "code"),
    [(0.0, 0), (2.5, 2), (1.25 * 0.5, 0), (1.25 * 1.5, 2), (-1.25 * 2.5, -2), (10.0, 7), (99, 7), (-10, -8), (-99, -8)],
)
def test_converter_codes(value, code):
    """4 bits over ±10 V: an LSB of 1.25 V, codes −8 … 7, halves to the even code."""
    assert quantise(*lsb_and_range(-10.0, 10.0, 4), float(value)) == 1.25 * code
    if 2.5 > abs(value) > 0:
        assert quantise(*lsb_and_range(-10.0, 10.0, 4), float(value)) == 1.25 * round(Fraction(value) / Fraction(1.25))


@pytest.mark.parametrize(("bits", "highest_v"), [(4, 9.375), (0, 10.0)])
def test_a_converter_of_one_sign_clips_at_0_v(bits, highest_v):
    """4 bits over 0 … 10 V: an LSB of 0.625 V, codes 0 … 15."""
    span = lsb_and_range(0.0, 10.0, bits)
    assert [quantise(*span, value) for value in (-3.0, -1e-9, 0.0, 2.5, 99.0)] == [0.0, 0.0, 0.0, 2.5, highest_v]


def test_an_adc_of_one_sign_reads_no_noise_below_0_v(run):
    plant = PlantOptions(sensor=SensorOptions(um_per_v=1.0, noise_um=0.1), adc=ConverterOptions(min_v=0.0))
    adc_v = run(np.zeros(1000), RigOptions(plant=plant)).adc_v
    assert adc_v.min() == 0.0
    assert 0.4 < np.mean(adc_v == 0.0) < 0.6
    assert 0.2 < adc_v.max() < 0.5


@given(st.floats(-9.9, 9.9), st.integers(8, 32))
def test_converter_error_is_half_an_lsb_at_most(value, bits):
    lsb, output = 20 / 2**bits, quantise(*lsb_and_range(-10.0, 10.0, bits), value)
    assert abs(output - value) <= lsb / 2 * (1 + 1e-6)
    assert float(output / lsb).is_integer()


@given(st.floats(-1e308, 1e308) | st.just(float("inf")) | st.just(float("-inf")))
def test_ideal_converter_clips_only(value):
    assert quantise(*lsb_and_range(-10.0, 10.0, 0), value) == min(max(value, -10.0), 10.0)


@pytest.mark.parametrize("bits", [0, 16])
def test_nan_stays_visible_in_the_adc(bits):
    assert np.isnan(quantise(*lsb_and_range(-10.0, 10.0, bits), float("nan")))


@pytest.mark.parametrize("latency", [0, 1, 3, 16])
def test_latency(run, ideal, latency):
    """A drive written in tick k is in the signals of tick k + 1 + latency; earlier signals are 0 V."""
    drive = np.arange(1.0, 61.0)
    signals = run(drive, ideal(latency_ticks=latency, dynamics=RIGID)).adc_v
    np.testing.assert_array_equal(signals, np.concatenate([np.zeros(1 + latency), drive])[: drive.size])


@pytest.mark.parametrize("latency", [0, 2])
def test_nan_at_the_dac_holds_the_last_value(run, ideal, latency):
    drive = [1.0, np.nan, np.nan, 4.0, 5.0, 0.0, 0.0, 0.0]
    signals = run(drive, ideal(latency_ticks=latency, dynamics=RIGID)).adc_v
    assert list(signals[latency + 1 : latency + 6]) == [1.0, 1.0, 1.0, 4.0, 5.0]


def test_dac_and_adc_both_convert(run):
    """4 bits in the DAC: 3 V leaves as 2.5 V. 3 bits in the ADC at ±8 V: 2.5 V arrives as 2 V."""
    plant = PlantOptions(
        hysteresis={"truth": "custom", "thresholds_v": (0.0,), "weights_um_per_v": (1.0,)},  # type: ignore[arg-type]
        dynamics=RIGID,
        sensor=SensorOptions(um_per_v=1.0, noise_um=0.0, resolution_um=0.0),
        adc=ConverterOptions(range_v=8.0, bits=3),
        dac=ConverterOptions(bits=4),
    )
    signals = run([3.0, 3.0], RigOptions(plant=plant))
    assert signals.true_um[1] == 2.5
    assert signals.adc_v[1] == 2.0

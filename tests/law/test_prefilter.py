"""The reference pre-filter against scipy's filters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from rtloop.signals import Mode
from tests.law.harness import LawBench, coefficients_of

REFERENCE = np.random.default_rng(7).normal(0, 5, 3000)
BUTTER = signal.butter(6, 0.05, output="sos")
NOTCH = signal.iirnotch(595.5, 30, 10000)


def filtered(**prefilter) -> np.ndarray:
    """What the law makes of the reference: the error at position 0."""
    return LawBench(coefficients_of(prefilter=prefilter), Mode.OFF).run(REFERENCE).error_um


def sections(sos: np.ndarray) -> list[list[float]]:
    """scipy's b0 b1 b2 1 a1 a2 without the 1."""
    return np.delete(sos, 3, axis=1).tolist()


@pytest.mark.parametrize("count", [1, 2, 3, 17, 128])
def test_taps(count):
    taps = np.random.default_rng(count).normal(0, 1, count)
    np.testing.assert_allclose(filtered(taps=taps.tolist()), signal.lfilter(taps, 1.0, REFERENCE), rtol=0, atol=1e-11)


def test_sections():
    sos = np.vstack([BUTTER, np.concatenate(NOTCH)])
    expected = REFERENCE
    for section in sos:
        expected = signal.lfilter(section[:3], section[3:], expected)
    np.testing.assert_allclose(filtered(sections=sections(sos)), expected, rtol=0, atol=1e-11)


def test_taps_then_sections():
    taps = [0.5, 0.25, 0.25]
    expected = signal.sosfilt(BUTTER, signal.lfilter(taps, 1.0, REFERENCE))
    np.testing.assert_allclose(filtered(taps=taps, sections=sections(BUTTER)), expected, rtol=0, atol=1e-11)


def test_none_is_transparent():
    assert filtered().tobytes() == REFERENCE.tobytes()


@pytest.mark.parametrize(
    ("prefilter", "message"),
    [
        ({"taps": [0.1] * 129}, "129 taps and 0 sections: at most 128 and 12"),
        ({"sections": [[1.0, 0.0, 0.0, -2.0, 1.0]]}, "unstable"),
        ({"sections": [[1.0, 0.0, 0.0, -2.1]]}, "five numbers b0, b1, b2, a1, a2"),
        ({"sections": [[1.0, 0.0, 0.0, 0.0, 0.0]] * 13}, "0 taps and 13 sections"),
    ],
)
def test_filters_that_cannot_be(prefilter, message):
    with pytest.raises(ValueError, match=message):
        coefficients_of(prefilter=prefilter)

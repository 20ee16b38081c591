"""The reference pre-filter against scipy's filters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from rtloop.signals import Mode
from tests.kernel.harness import LawBench, make_coefficients

REFERENCE = np.random.default_rng(7).normal(0, 5, 3000)
BUTTER = signal.butter(6, 0.05, output="sos")
NOTCH = signal.iirnotch(595.5, 30, 10000)


def filter_reference(**prefilter) -> np.ndarray:
    """Return the reference behind this pre-filter: the error at position 0."""
    return LawBench(make_coefficients(prefilter=prefilter), Mode.OFF).run(REFERENCE).error_um


def sections(sos: np.ndarray) -> list[list[float]]:
    """Return scipy's sections, rows of b0 b1 b2 1 a1 a2, as lists of five numbers without the 1."""
    return np.delete(sos, 3, axis=1).tolist()


def random_taps(count: int) -> list[float]:
    return np.random.default_rng(count).normal(0, 1, count).tolist()


@pytest.mark.parametrize(
    ("taps", "sos"),
    [
        *((random_taps(count), np.zeros((0, 6))) for count in (1, 2, 3, 17, 128)),
        ([], np.vstack([BUTTER, np.concatenate(NOTCH)])),
        ([0.5, 0.25, 0.25], BUTTER),
    ],
)
def test_taps_then_sections(taps, sos):
    expected = signal.lfilter(taps or [1.0], 1.0, REFERENCE)
    for section in sos:
        expected = signal.lfilter(section[:3], section[3:], expected)
    np.testing.assert_allclose(filter_reference(taps=taps, sections=sections(sos)), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("count", "command_count"), [(0, 1), (1, 5), (48, 48), (3, 128), (128, 2)])
def test_the_second_row_is_added_to_the_command(count, command_count):
    """The command of a controller of gain 0.1 is v = f_v * r + feed + 0.1 (f_x * r), after any history of r."""
    random = np.random.default_rng(command_count)
    taps, command_taps = random.normal(0, 0.1, count), random.normal(0, 0.1, command_count)
    bench = LawBench(
        make_coefficients(
            controller={"form": "transfer_function", "numerator": [0.1], "denominator": [1.0]},
            prefilter={"taps": taps.tolist(), "command_taps": command_taps.tolist()},
        )
    )
    bench.run(REFERENCE[:300], mode=Mode.RAW)
    feed_um = np.random.default_rng(3).normal(0, 1, 900)
    commands_um = bench.run(REFERENCE[300:1200], mode=Mode.CLOSED_LOOP, feed_um=feed_um).command_um
    history = np.concatenate([np.full(128, REFERENCE[300]), REFERENCE[300:1200]])
    added_um = signal.lfilter(command_taps, 1.0, history)[128:] + feed_um
    filtered_um = signal.lfilter(taps if count else [1.0], 1.0, history)[128:]
    # the offset of the bumpless entry has decayed for 0.08 s with a time constant of 0.02 s
    np.testing.assert_allclose(commands_um[-100:], (added_um + 0.1 * filtered_um)[-100:], rtol=0, atol=0.2)
    np.testing.assert_allclose(
        np.diff(commands_um)[-100:], np.diff(added_um + 0.1 * filtered_um)[-100:], rtol=0, atol=5e-3
    )


def test_what_the_reference_adds_is_none_of_the_controllers_memory():
    """An integrator continues from the command in force and does not wind up beyond the limit of the sum."""
    parts = {"controller": {"form": "zpk", "gain": 50.0, "zeros": [], "poles": [[0.0, 0.0]]}}
    for feed_um in (0.0, 3.0, -3.0):
        bench = LawBench(make_coefficients(limits={"command_um": 5.0}, **parts))
        in_force_um = bench.run(np.full(200, 2.0), mode=Mode.FEEDFORWARD).applied_um[-1]
        started = bench.run(np.full(50, 1.0), adc_v=0.1, mode=Mode.CLOSED_LOOP, feed_um=feed_um)
        np.testing.assert_allclose(started.command_um, in_force_um, atol=1e-12)
        limited = bench.run(np.full(5000, 11.0), adc_v=0.1, feed_um=feed_um)
        assert limited.command_um.max() < 6.0
        reversed_signals = bench.run(np.full(400, -19.0), adc_v=0.1, feed_um=feed_um)
        assert reversed_signals.command_um[-1] < 4.5


def test_none_is_transparent():
    assert filter_reference().tobytes() == REFERENCE.tobytes()


@pytest.mark.parametrize(
    ("prefilter", "message"),
    [
        ({"taps": [0.1] * 129}, "129 taps and 0 sections; allowed: up to 128 taps and 12 sections"),
        ({"command_taps": [0.1] * 130}, "130 taps and 0 sections; allowed: up to 128 taps and 12 sections"),
        ({"sections": [[1.0, 0.0, 0.0, -2.0, 1.0]]}, "unstable"),
        ({"sections": [[1.0, 0.0, 0.0, -2.1]]}, "five numbers b0, b1, b2, a1, a2"),
        ({"sections": [[1.0, 0.0, 0.0, 0.0, 0.0]] * 13}, "0 taps and 13 sections"),
    ],
)
def test_filters_that_cannot_be(prefilter, message):
    with pytest.raises(ValueError, match=message):
        make_coefficients(prefilter=prefilter)


@pytest.mark.parametrize("sos", [BUTTER, np.concatenate(NOTCH)[None, :]])
def test_sections_begin_at_rest_for_the_first_reference(sos):
    """A constant reference passes at the gain at 0 Hz from the first tick of a mode that drives."""
    bench = LawBench(make_coefficients(prefilter={"sections": sections(sos)}))
    constant = bench.run(np.full(50, 3.0), mode=Mode.FEEDFORWARD)
    gain = np.prod(sos[:, :3].sum(axis=1) / sos[:, 3:].sum(axis=1))
    np.testing.assert_allclose(constant.error_um, 3.0 * gain, rtol=1e-9)


def test_taps_of_both_rows_and_sections_begin_at_rest_together():
    """A constant reference passes taps and sections from the first tick; command taps do not change the error."""
    taps, command_taps = [0.5, 0.2], [0.1, 0.3, -0.15]
    prefilter = {"taps": taps, "command_taps": command_taps, "sections": sections(BUTTER)}
    constant = LawBench(make_coefficients(prefilter=prefilter)).run(np.full(50, 3.0), mode=Mode.FEEDFORWARD)
    gain = np.prod(BUTTER[:, :3].sum(axis=1) / BUTTER[:, 3:].sum(axis=1))
    np.testing.assert_allclose(constant.error_um, 3.0 * sum(taps) * gain, rtol=1e-9)

"""The static gain from a staircase, on plants of known gain with noise and with residual hysteresis."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.analysis.measured.gain import STEPS, staircase, static_gain
from rtloop.hysteresis.plays import play_outputs

RATE_HZ = 10_000.0


def test_a_staircase_goes_out_and_back_in_equal_steps_without_a_jump():
    reference = staircase(3.0, -5.0, RATE_HZ)
    levels = np.unique(np.round(reference.reshape(2 * STEPS + 1, -1)[:, -1], 9))
    np.testing.assert_allclose(levels, np.linspace(-5.0, 3.0, STEPS + 1))
    assert (reference[0], reference[-1], reference.min()) == (3.0, 3.0, -5.0)
    assert np.abs(np.diff(reference)).max() < 0.01


@pytest.mark.parametrize(("noise_um", "largest_std"), [(0.01, 0.001), (0.1, 0.01)])
def test_its_standard_deviation_covers_the_error_that_noise_makes(noise_um: float, largest_std: float):
    random, reference = np.random.default_rng(1), staircase(0.0, 10.0, RATE_HZ)
    gains = []
    for _ in range(20):
        position = reference + noise_um * random.standard_normal(reference.size)
        gains.append(static_gain(reference, position, reference / 0.95 + 2.0, RATE_HZ))
    errors = np.array([(gain.value - 0.95) / gain.std for gain in gains])
    assert np.abs(errors).max() < 3.0
    assert max(gain.std for gain in gains) < largest_std
    assert (gains[0].from_um, gains[0].to_um) == (0.0, 10.0)


def test_hysteresis_that_is_left_is_in_the_standard_deviation_and_its_turns_are_left_out():
    """x = 0.97 v + 0.03 F_0.5[v] has slope 1, and slope 0.97 for 1 µm after a turn."""
    command = staircase(0.0, 10.0, RATE_HZ)
    position = 0.97 * command + 0.03 * play_outputs(command, [0.5])[:, 0]
    gain = static_gain(command, position, command, RATE_HZ)
    assert gain.value == pytest.approx(1.0, abs=0.001)
    assert 0.0 < gain.std < 0.001


def test_its_standard_deviation_is_that_of_a_mean_of_slopes():
    """Fourteen steps count; their slopes scatter by 2 %."""
    command, random = staircase(0.0, 10.0, RATE_HZ), np.random.default_rng(2)
    plateaus = command.reshape(2 * STEPS + 1, -1)
    slopes = 1.0 + 0.02 * random.standard_normal(2 * STEPS)
    levels = np.concatenate([[0.0], np.cumsum(slopes * np.diff(plateaus[:, -1]))])
    position = np.repeat(levels, plateaus.shape[1])
    counted = np.delete(slopes, [0, STEPS])
    assert static_gain(command, position, command, RATE_HZ).std == pytest.approx(
        np.std(counted, ddof=1) / np.sqrt(14), rel=1e-9
    )


@pytest.mark.parametrize(
    ("factor", "problem"),
    [(-1.0, "falls at every step that raises the command"), (0.0, "did not move command and position in one")],
)
def test_a_position_that_does_not_follow_is_refused(factor: float, problem: str):
    reference = staircase(0.0, 10.0, RATE_HZ)
    with pytest.raises(ValueError, match=problem):
        static_gain(reference, factor * reference, reference, RATE_HZ)

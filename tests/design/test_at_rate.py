"""Approximated dead time against the exact exponential, and the gain that remains when fast roots are dropped."""

import math

import numpy as np
import pytest

from rtloop.design.synthesis.rate_limits import dead_time, drop_fast_roots, is_runnable
from rtloop.design.synthesis.synthesise import NotRunnable, synthesise
from rtloop.design.synthesis.weights import PAPER_WEIGHTS
from rtloop.linear.transfer import Transfer

RATE_HZ = 10_000.0
BAND = 1j * np.geomspace(1.0, math.pi * RATE_HZ, 200)
MODE = Transfer.from_factors(2.5e7, [], [[1.0, 200.0, 2.5e7]])


@pytest.mark.parametrize(("ticks", "order"), [(0.5, 1), (1.5, 2), (2.5, 3), (3.5, 4)])
def test_dead_time_is_that_of_the_exponential(ticks, order) -> None:
    """The error stays below 1 % up to 1 kHz, where |C D| is not small; the magnitude is 1 at every frequency."""
    approximation, delay_s = dead_time(ticks / RATE_HZ, order), ticks / RATE_HZ
    assert approximation.order == order
    assert np.abs(approximation.response(BAND)) == pytest.approx(1.0, rel=1e-9)
    low = BAND[np.abs(BAND) < 2000 * math.pi]
    assert np.abs(approximation.response(low) - np.exp(-low * delay_s)).max() < 0.01
    assert approximation.is_stable


def test_no_delay_is_one() -> None:
    assert (dead_time(0.0, 3).order, dead_time(0.0, 3).gain) == (0, 1.0)


def test_roots_far_beyond_the_rate_leave_their_gain() -> None:
    near = Transfer.from_zpk([-5.0], [-1.0, -3e4], 7.0)
    far = Transfer.from_zpk([*near.zeros, 4e13], [*near.poles, -6e12], 7.0 * 6e12 / -4e13)
    reduced = drop_fast_roots(far, RATE_HZ)
    assert reduced.zeros.tolist() == near.zeros.tolist()
    assert reduced.poles.tolist() == near.poles.tolist()
    assert reduced.gain == pytest.approx(near.gain, rel=1e-12)


def test_a_far_pole_stays_where_a_zero_would_be_left_without_one_or_it_is_unstable() -> None:
    for poles in ([-1e12], [1e12]):
        assert drop_fast_roots(Transfer.from_zpk([-5.0], poles, 1.0), RATE_HZ).poles.tolist() == poles


def test_too_high_an_order_does_not_run() -> None:
    """The law has room for 24 states."""
    rates = -np.arange(1.0, 26.0)
    for count, runs in ((24, True), (25, False)):
        controller = Transfer.from_zpk(rates[: count - 1] - 0.5, rates[:count], 1.0)
        assert is_runnable(controller, MODE, RATE_HZ, "matched", None, 0) is runs


def test_where_nothing_runs_the_message_says_what_would_help() -> None:
    with pytest.raises(
        NotRunnable, match=r"no controller of order 0 to 4 gives a stable sampled loop .*; use a longer settling_ms"
    ):
        synthesise(MODE, PAPER_WEIGHTS._replace(disturbance=Transfer.from_zpk([], [], 0.0)), finish=lambda _: None)

"""Dead time against the exponential itself, and roots that are left out against what they turn within the band."""

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
    """As near as it matters where |C D| is not small: up to 1 kHz. Nowhere does it change a magnitude."""
    found, tau = dead_time(ticks / RATE_HZ, order), ticks / RATE_HZ
    assert found.order == order
    assert np.abs(found.response(BAND)) == pytest.approx(1.0, rel=1e-9)
    low = BAND[np.abs(BAND) < 2000 * math.pi]
    assert np.abs(found.response(low) - np.exp(-low * tau)).max() < 0.01
    assert found.is_stable


def test_no_delay_is_one() -> None:
    assert (dead_time(0.0, 3).order, dead_time(0.0, 3).gain) == (0, 1.0)


def test_roots_far_beyond_the_rate_leave_their_gain() -> None:
    near = Transfer.from_zpk([-5.0], [-1.0, -3e4], 7.0)
    far = Transfer.from_zpk([*near.zeros, 4e13], [*near.poles, -6e12], 7.0 * 6e12 / -4e13)
    found = drop_fast_roots(far, RATE_HZ)
    assert found.zeros.tolist() == near.zeros.tolist()
    assert found.poles.tolist() == near.poles.tolist()
    assert found.gain == pytest.approx(near.gain, rel=1e-12)


def test_a_far_pole_stays_where_a_zero_would_be_left_without_one_or_it_is_unstable() -> None:
    for poles in ([-1e12], [1e12]):
        assert drop_fast_roots(Transfer.from_zpk([-5.0], poles, 1.0), RATE_HZ).poles.tolist() == poles


def test_too_high_an_order_does_not_run() -> None:
    """The law has room for 24 states."""
    rates = -np.arange(1.0, 26.0)
    for count, says in ((24, True), (25, False)):
        controller = Transfer.from_zpk(rates[: count - 1] - 0.5, rates[:count], 1.0)
        assert is_runnable(controller, MODE, RATE_HZ, "matched", None, 0) is says


def test_where_nothing_runs_the_message_says_what_would_help() -> None:
    with pytest.raises(
        NotRunnable, match=r"no controller of order 0 to 4 gives a stable sampled loop .*; use a longer settling_ms"
    ):
        synthesise(MODE, PAPER_WEIGHTS._replace(disturbance=Transfer.from_zpk([], [], 0.0)), finish=lambda _: None)

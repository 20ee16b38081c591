"""Output of each mode, and changes from one mode to another."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy import signal

from rtloop.drivers.base import Channel
from rtloop.kernel.memory import slot_view
from rtloop.laws.shipped.transfer import COEFFICIENTS
from rtloop.signals import Flag, Mode
from tests.kernel.harness import EQ_4, EQ_20, EXACT, PERIOD_S, LawBench, make_coefficients
from tests.kernel.oracle import Hysteresis, P, R, sine

PLAIN = make_coefficients(controller=EQ_20)
PI = make_coefficients(
    controller={"form": "transfer_function", "numerator": [0.5, 40.0], "denominator": [1.0, 0.0], "method": "tustin"}
)


def test_raw_is_the_reference_in_volts():
    volts = sine(10.0, 999)
    signals = LawBench(PLAIN, Mode.RAW).run(volts)
    assert np.array_equal(signals.drive_v, volts)
    assert not np.any(signals.flags)


def test_feedforward_is_the_inverse_of_eq_4():
    """w = Σ g_j F_{z_j}[v], by Kuhnen's formulas (2003)."""
    sums = np.cumsum(P)
    z = np.array([P[: j + 1] @ (R[j] - R[: j + 1]) for j in range(R.size)])
    g = np.array([1 / P[0], *(-P[1:] / (sums[1:] * sums[:-1]))])
    command = np.concatenate([sine(40.0, 3001), sine(23.0, 2001, 3.7)])
    signals = LawBench(PLAIN, Mode.FEEDFORWARD).run(command)
    np.testing.assert_allclose(signals.drive_v, Hysteresis(z, g).run(command), rtol=0, atol=1e-12)
    assert np.array_equal(signals.command_um, command)


def test_the_controller_is_the_difference_equation():
    """A PI controller by the bilinear rule, against scipy on the error that the law reports."""
    reference, adc_v = sine(3.0, 4001, 5.0), 0.01 * sine(3.0, 4001, 4.0)
    signals = LawBench(PI, Mode.CLOSED_LOOP).run(reference, adc_v)
    np.testing.assert_allclose(signals.error_um, reference - 10 * adc_v, rtol=0, atol=1e-13)
    b, a = signal.bilinear([0.5, 40.0], [1.0, 0.0], 1 / PERIOD_S)
    assert not np.any(signals.flags)
    np.testing.assert_allclose(signals.command_um, signal.lfilter(b, a, signals.error_um), rtol=0, atol=1e-9)


def test_a_controller_without_integrator_goes_on_beside_a_feed():
    """The controller is entered at a command of 10 µm with a feed of 4 µm, and rests with the other 6 µm."""
    lag = {"form": "transfer_function", "numerator": [40.0], "denominator": [1.0, 50.0]}
    bench = LawBench(make_coefficients(controller=lag, feedforward=EXACT, limits={"bump_s": 1e9}), Mode.FEEDFORWARD)
    bench.run(np.full(50, 10.0))
    signals = bench.run(np.full(600, 1.0), mode=Mode.CLOSED_LOOP, feed_um=4.0)
    np.testing.assert_allclose(signals.command_um, 10.0, rtol=0, atol=1e-6)
    assert not np.any(signals.flags)


def test_a_controller_without_states_continues_by_an_offset_that_dies_out():
    """v = 0.5 e = 4 µm, entered at 10 µm: the offset of 6 µm decays by exp(−T/bump_s) in each tick."""
    gain = {"form": "transfer_function", "numerator": [0.5], "denominator": [1.0]}
    bench = LawBench(make_coefficients(controller=gain, feedforward=EXACT, limits={"bump_s": 0.01}), Mode.FEEDFORWARD)
    bench.run(np.full(50, 10.0))
    command_um = bench.run(np.full(1500, 8.0), mode=Mode.CLOSED_LOOP).command_um
    assert command_um[0] == pytest.approx(10.0, abs=1e-9)
    decay = np.exp(-PERIOD_S / 0.01 * np.arange(1, 1500))
    np.testing.assert_allclose(command_um[1:], 4.0 + 6.0 * decay, atol=2e-5)


def test_limited_commands_and_drives_say_so():
    bench = LawBench(make_coefficients(limits={"command_um": 30.0, "drive_v": 5.0}), Mode.FEEDFORWARD)
    flags = [Flag(int(value)) for value in bench.run([10.0, 30.0, 30.1, -30.1]).flags]
    assert flags[0] == 0
    assert flags[1] == Flag.DRIVE_LIMITED
    assert flags[2] == flags[3] == Flag.COMMAND_LIMITED | Flag.DRIVE_LIMITED
    assert bench.axes.drive_v[0] == -5.0


def test_an_amplifier_without_a_negative_side():
    """The drive is limited to the channel's 0 … 5 V, and the message about a limit beyond them names the limit."""
    channel = Channel("ao0", 0.0, 5.0)
    bench = LawBench(make_coefficients(channel, limits={"drive_v": 5.0, "drive_min_v": 0.0}), Mode.RAW)
    signals = bench.run([3.0, -0.1, 5.0, 7.0])
    assert list(signals.drive_v) == [3.0, 0.0, 5.0, 5.0]
    assert list(signals.flags) == [0, Flag.DRIVE_LIMITED, 0, Flag.DRIVE_LIMITED]
    for limits, fault in (
        ({"drive_v": 5.0}, "limits.drive_min_v: not set, which means −5.0 V; allowed: within the driver's 0.0 … 5.0 V"),
        ({"drive_v": 6.0, "drive_min_v": 0.0}, "limits.drive_v: 6.0 V; allowed: within the driver's 0.0 … 5.0 V"),
        ({"drive_v": 5.0, "drive_min_v": -1.0}, "limits.drive_min_v: −1.0 V; allowed: within the driver's 0.0 … 5.0 V"),
    ):
        with pytest.raises(ValueError, match=re.escape(fault)):
            make_coefficients(channel, limits=limits)


def test_off_ramps_to_the_safe_value_and_stays():
    bench = LawBench(PLAIN, Mode.RAW)
    bench.run([6.0])
    signals = bench.run(np.full(70, 9.0), mode=Mode.OFF)
    np.testing.assert_allclose(signals.drive_v[:60], 6.0 - 0.1 * np.arange(1, 61), rtol=0, atol=1e-13)
    assert np.all(signals.drive_v[60:] == 0.0)
    assert np.all(signals.flags[:59] == Flag.RAMPING)
    assert np.all(signals.flags[61:] == 0)


def test_tick_zero_starts_from_zero_state():
    """The first tick continues no earlier output: the command is C(∞) e, without an offset."""
    signals = LawBench(PLAIN, Mode.CLOSED_LOOP).run([20.0])
    assert signals.command_um[0] == pytest.approx(slot_view(PLAIN[0], "controller", COEFFICIENTS).d * 20.0)
    assert LawBench(PLAIN, Mode.FEEDFORWARD).run([20.0]).command_um[0] == 20.0
    assert LawBench(PLAIN, Mode.RAW).run([7.0]).drive_v[0] == 7.0


@pytest.mark.parametrize("before", [Mode.RAW, Mode.FEEDFORWARD, Mode.CLOSED_LOOP])
@pytest.mark.parametrize("after", [Mode.RAW, Mode.FEEDFORWARD, Mode.CLOSED_LOOP])
@pytest.mark.parametrize("dead_band", ["none", "exact"])
def test_a_new_mode_continues_where_the_old_one_was(before, after, dead_band):
    """The demand continues in any mode and from any drive, also from one outside its limits, and in the same mode."""
    axis = make_coefficients(controller=EQ_20, feedforward=EQ_4 | {"dead_band": dead_band})
    for level in (0.3, 5.0, -8.0):
        for pause in (1, 50):
            bench = LawBench(axis, before)
            last_v = bench.run(level * np.sin(np.arange(40) / 9), 0.01).drive_v[-1]
            entered = bench.run(np.full(pause, 2.0), 0.02, mode=after)
            assert abs(entered.demand_v[0] - last_v) < 1e-6


def test_the_offset_of_a_change_dies_out():
    """The offset decays to 0 with the time constant bump_s = 0.02 s."""
    bench = LawBench(PLAIN, Mode.RAW)
    bench.run([6.0])
    signals = bench.run(np.full(6000, 1.0), mode=Mode.FEEDFORWARD)
    offset_um = signals.command_um - 1.0
    np.testing.assert_allclose(offset_um[:2000], offset_um[0] * np.exp(-np.arange(2000) / 200), rtol=1e-9)
    assert offset_um[-1] == 0.0


def test_a_trip_refuses_nothing_but_ends_the_mode():
    bench = LawBench(PLAIN, Mode.CLOSED_LOOP)
    signals = bench.run(np.zeros(5), modes=Mode.RAW, status=[0, 0, -1, 0, 0])
    assert list(signals.mode) == [Mode.RAW, Mode.RAW, Mode.OFF, Mode.OFF, Mode.OFF]

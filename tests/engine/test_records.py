"""Records of the loop: equal bytes for equal seeds, and snapshots from which the law continues."""

from __future__ import annotations

import numpy as np

from tests.engine.harness import AXIS, CONTROLLER, MATCHED, LoopBench, text
from tests.kernel.harness import LawBench

SINE = '[axis.reference]\nkind = "sine"\namplitude = 20.0\nfrequency_hz = 17.0\n'
PREFILTER = "[axis.prefilter]\ntaps = [0.5, 0.3, 0.2]\n"
TICKS = 25_000


def bench(seed: int = 1, rate_hz: float = 10_000) -> LoopBench:
    """Return a loop on the paper's noisy rig."""
    return LoopBench(text(AXIS, CONTROLLER, MATCHED, PREFILTER, SINE, seed=seed, rate_hz=rate_hz))


def test_the_same_seed_gives_the_same_bytes():
    first, same_seed, other_seed = (bench(seed).run(TICKS) for seed in (1, 1, 2))
    assert first.tobytes() == same_seed.tobytes()
    assert first.tobytes() != other_seed.tobytes()
    assert np.array_equal(first[:, 0], np.arange(TICKS))


def test_pieces_give_the_same_bytes_as_a_whole():
    in_one_piece, in_pieces = bench(), bench()
    parts = [in_pieces.run(count) for count in (1, 999, 1, 7000, 16_999)]
    assert np.concatenate(parts).tobytes() == in_one_piece.run(TICKS).tobytes()


def test_a_snapshot_a_second_each_at_the_state_before_its_tick():
    loop = bench(rate_hz=1000)
    rows = loop.run(2_500)
    snapshots = loop.drain("snapshots")
    assert [loop.plan.layout.split_snapshot(snapshot, 1)[0] for snapshot in snapshots] == [0, 1000, 2000]
    for snapshot in snapshots:
        tick, coefficients, axes, state = loop.plan.layout.split_snapshot(snapshot, 1)
        law = LawBench(coefficients)
        law.axes[:], law.loops[:] = axes, state
        later_rows = rows[tick:]
        inputs = {"adc_v": loop.column(later_rows, "x_adc_v"), "age_us": loop.column(later_rows, "sample_age_us")}
        signals = law.run(loop.column(later_rows, "x_reference_um"), **inputs)
        assert signals.drive_v.tobytes() == loop.column(later_rows, "x_drive_v").tobytes()
        assert signals.demand_v.tobytes() == loop.column(later_rows, "x_demand_v").tobytes()
        assert law.axes.tobytes() == loop.law.axes.tobytes()


def test_records_agree_with_each_other():
    loop = bench()
    rows = loop.run(2000)
    position = 10.0 * loop.column(rows, "x_adc_v")
    assert np.array_equal(loop.column(rows, "x_position_um"), position)
    expected_um = np.convolve(loop.column(rows, "x_reference_um"), [0.5, 0.3, 0.2])[:2000]
    np.testing.assert_allclose(loop.column(rows, "x_error_um"), expected_um - position, rtol=0, atol=1e-12)
    assert np.abs(loop.column(rows, "x_true_position_um") - position).max() < 0.06  # noise and resolution of 10 nm


def test_two_axes_do_not_touch_each_other():
    """An axis gives the same bits with a second axis as alone."""
    configuration = text(AXIS, CONTROLLER, MATCHED, SINE, AXIS.replace('"x"', '"y"'), CONTROLLER, MATCHED)
    channels = '[driver.channels.y]\ninput = "adc1"\noutput = "dac1"\num_per_v = 10.0\n[[axis]]'
    two_axes = LoopBench(configuration.replace("[[axis]]", channels, 1))
    one_axis = LoopBench(text(AXIS, CONTROLLER, MATCHED, SINE))
    rows, one_axis_rows = two_axes.run(3000), one_axis.run(3000)
    for name in ("x_adc_v", "x_drive_v", "x_true_position_um"):
        assert two_axes.column(rows, name).tobytes() == one_axis.column(one_axis_rows, name).tobytes()
    assert np.abs(two_axes.column(rows, "y_true_position_um")).max() < 1.0

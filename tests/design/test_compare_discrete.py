"""The shift of the notch of eq (20) by discretisation, and its warnings, against frequencies computed by hand."""

import json

import pytest

from rtloop.analysis.comparison import compare_controllers
from rtloop.design.paper import PAPER_C
from rtloop.linear.discretise import discretise_controller
from rtloop.linear.transfer import Transfer

PERIOD_S = 1e-4


def test_plain_tustin_moves_the_notch_and_is_warned_about() -> None:
    """(w + z)/(w − z) with w = 2/T brings the zero pair s² + 43 s + 1.4e7 to 588.70 Hz."""
    comparison = compare_controllers(PAPER_C, discretise_controller(PAPER_C, PERIOD_S, "tustin"))
    notch = next(shift for shift in comparison.shifts if shift.kind == "notch")
    assert notch.frequency_hz == pytest.approx(595.50, abs=0.01)
    assert notch.discrete_hz == pytest.approx(588.70, abs=0.01)
    assert notch.damping == pytest.approx(43 / 2 / 1.4e7**0.5)
    warning = next(text for text in comparison.warnings if "notch" in text)
    assert "595.5" in warning
    assert "588.7" in warning
    assert comparison.max_deviation > 2
    assert comparison.max_deviation_hz == pytest.approx(595.5, abs=0.1)


@pytest.mark.parametrize(("method", "prewarp_hz"), [("tustin", 595.5), ("matched", None), ("foh", None)])
def test_methods_that_keep_the_notch_are_not(method, prewarp_hz) -> None:
    comparison = compare_controllers(PAPER_C, discretise_controller(PAPER_C, PERIOD_S, method, prewarp_hz))
    assert comparison.warnings == []
    notch = next(shift for shift in comparison.shifts if shift.kind == "notch")
    assert notch.discrete_hz == pytest.approx(595.5, abs=0.25)


def test_deviation_is_small_where_the_sampling_is_fast() -> None:
    """Tustin's error is of second order: sampling 100 times faster makes the error 10,000 times smaller."""
    smooth = Transfer.from_factors(100, [[1, 300]], [[1, 40], [1, 900]])
    slow, fast = (
        compare_controllers(smooth, discretise_controller(smooth, period_s, "tustin"), 100.0)
        for period_s in (1e-3, 1e-5)
    )
    assert slow.up_to_hz == fast.up_to_hz == 100.0
    assert slow.max_deviation / fast.max_deviation == pytest.approx(1e4, rel=0.1)


def test_a_notch_above_half_the_sampling_rate_is_lost() -> None:
    comparison = compare_controllers(PAPER_C, discretise_controller(PAPER_C, 1e-3, "matched"))
    assert any("loses the notch at 595.5 Hz" in text for text in comparison.warnings)
    assert json.loads(json.dumps(comparison.as_dict(), allow_nan=False))["shifts"][0]["discrete_hz"] is None


def test_an_undamped_notch_is_judged_by_its_frequency() -> None:
    undamped = Transfer.from_factors(1, [[1, 0, 1.4e7]], [[1, 900], [1, 4000]])
    assert compare_controllers(undamped, discretise_controller(undamped, PERIOD_S, "matched")).warnings == []
    assert len(compare_controllers(undamped, discretise_controller(undamped, PERIOD_S, "tustin")).warnings) == 1


def test_two_notches_keep_their_own_images() -> None:
    notches = Transfer.from_factors(1, [[1, 10, 1.4e7], [1, 10, 1.5e7]], [[1, 900], [1, 4000], [1, 5000], [1, 6000]])
    shifts = compare_controllers(notches, discretise_controller(notches, PERIOD_S, "tustin")).shifts
    assert len({shift.discrete_hz for shift in shifts}) == 2
    assert all(-0.02 < shift.relative < -0.01 for shift in shifts)


def test_a_static_gain_has_nothing_to_compare() -> None:
    gain = Transfer.from_zpk([], [], 2.0)
    comparison = compare_controllers(gain, discretise_controller(gain, PERIOD_S, "matched"))
    assert comparison.max_deviation == 0
    assert comparison.shifts == ()
    assert comparison.warnings == []

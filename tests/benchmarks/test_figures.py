"""Shares, quantiles, targets and the page are computed correctly from measured values; expected figures are by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.__main__ import BENCHMARKS
from tests.benchmarks.lateness import quantiles_us
from tests.benchmarks.page import BEGIN, END, MissingMarkers, rewrite
from tests.benchmarks.rates import late_shares
from tests.benchmarks.targets import TARGETS, Target, figures, number


def law():
    """Method of the benchmark."""


ENTRY = {
    "date": "2026-11-21T02:00:00Z", "revision": "abc", "pairs": 11, "share": 1.0, "load": 0.5,
    "results": {"ns": {"median": 1234.4, "minimum": 1.0, "maximum": 2000.0}, "other": {"why": "not measured: no card"}},
}  # fmt: skip


def test_late_shares_are_of_the_median_window():
    # Three complete windows of 1000 periods and the beginning of a fourth. The stall in the second changes no median.
    period = np.concatenate([np.arange(1000), np.arange(1500, 3100)])
    missed, flags = np.zeros(period.size), np.zeros(period.size)
    missed[1000], flags[1000] = 500.0, 1.0
    flags[period == 10] = flags[period == 2010] = 1.0 + 4.0
    flags[period == 2020] = 1.0
    flags[period == 20] = 4.0  # Another flag, no overrun.
    late = late_shares(period * 1e6, flags, missed)
    assert late.overrun == pytest.approx(2 / 1000)
    assert late.lost == pytest.approx(2 / 1000)
    stalled = late_shares(np.arange(500, 1001) * 1e6, np.zeros(501), np.array([500.0, *[0.0] * 500]))
    assert (stalled.overrun, stalled.lost) == (0.0, 0.5)


def test_quantiles_of_a_histogram():
    histogram = {300: 1, 100: 98, 200: 1}
    assert quantiles_us(histogram, 100) == {"p50": 0.1, "p99": 0.2}
    assert quantiles_us(histogram, 200) == {"p50": 0.3, "p99": 0.3}  # Half of the cycles lie beyond the histogram.


def test_page_is_rewritten_between_its_markers_alone(tmp_path):
    path = tmp_path / "page.md"
    path.write_text(f"before\n{BEGIN}old\n{END}after\n")
    for _ in range(2):
        rewrite(path, {"law": ENTRY}, {"law": law})
    text = path.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert "Method of the benchmark." in text
    assert "| ns | 1,234 | 1 … 2,000 | |" in text.replace("  ", " ")
    assert "| other why | – | not measured: no card | |" in text
    path.write_text("no markers\n")
    with pytest.raises(MissingMarkers, match=r"page\.md"):
        rewrite(path, {}, {"law": law})


def test_targets_judge_figures_that_exist():
    assert {name.split()[0] for name in TARGETS} <= set(BENCHMARKS)
    assert Target(1.1).is_met(1.1)
    assert not Target(1.1).is_met(1.2)
    assert Target(20.0, is_maximum=False).is_met(20.0)
    assert not Target(20.0, is_maximum=False).is_met(19.0)
    (figure,) = figures(
        "replay", {"one_process": {"times_real_time": {"median": 59.0, "minimum": 1.0, "maximum": 70.0}}}
    )
    assert figure.verdict == "≥ 120 MISSED"


def test_numbers_have_four_digits_and_no_exponent():
    assert [number(value) for value in (0.01234567, 12.3456, 100_000.0)] == ["0.01235", "12.35", "100,000"]

"""The yield of a campaign with its interval, against scipy's beta distributions."""

from __future__ import annotations

import math

import pytest
from scipy import stats

from rtloop.campaigns.summary import clopper_pearson


@pytest.mark.parametrize(("passed", "rigs"), [(0, 10), (10, 10), (7, 10), (999, 1000), (50, 100)])
def test_the_interval_is_that_of_clopper_and_pearson(passed, rigs):
    """The ends of the interval are quantiles of beta distributions."""
    estimate = clopper_pearson(passed, rigs)
    low = stats.beta.ppf(0.025, passed, rigs - passed + 1) if passed else 0.0
    high = stats.beta.ppf(0.975, passed + 1, rigs - passed) if passed < rigs else 1.0
    assert (estimate.low, estimate.high) == pytest.approx((low, high), rel=1e-9)
    assert estimate.share == passed / rigs


def test_without_rigs_nothing_is_known():
    estimate = clopper_pearson(0, 0)
    assert math.isnan(estimate.share)
    assert (estimate.low, estimate.high) == (0.0, 1.0)

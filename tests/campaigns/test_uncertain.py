"""Distributions of uncertain keys against the quantiles of scipy's distributions."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from rtloop.campaigns.uncertain import UncertainOptions

SHARES = np.linspace(0.001, 0.999, 41)


@pytest.mark.parametrize(
    ("options", "oracle"),
    [
        ({"uniform": (-2.0, 3.0)}, stats.uniform(-2.0, 5.0)),
        ({"log_uniform": (0.5, 2.0)}, stats.loguniform(0.5, 2.0)),
        ({"normal": (1.0, 0.2)}, stats.norm(1.0, 0.2)),
        ({"normal": (1.0, 0.2), "limits": (0.9, 1.5)}, stats.truncnorm(-0.5, 2.5, 1.0, 0.2)),
    ],
)
def test_quantiles_are_those_of_the_distribution(options, oracle):
    values = [UncertainOptions(**options).quantile(share) for share in SHARES]
    np.testing.assert_allclose(values, oracle.ppf(SHARES), rtol=1e-9, atol=1e-12)


def test_choices_are_equally_likely():
    options = UncertainOptions(choice=(1, "two", True))
    shares = (np.arange(300) + 0.5) / 300
    drawn = [options.quantile(share) for share in shares]
    assert [sum(value is entry for value in drawn) for entry in options.choice] == [100, 100, 100]
    assert not options.is_numeric


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "no distribution; allowed: exactly one of"),
        ({"uniform": (0.0, 1.0), "normal": (0.0, 1.0)}, "uniform, normal; allowed: exactly one of"),
        ({"uniform": (1.0, 1.0)}, "uniform: [1.0, 1.0]; allowed: the first number less than the second"),
        ({"log_uniform": (0.0, 1.0)}, "log_uniform: [0.0, 1.0]; allowed: numbers above 0"),
        ({"normal": (0.0, 0.0)}, "allowed: a standard deviation above 0"),
        ({"uniform": (0.0, 1.0), "limits": (0.0, 1.0)}, "limits is set without normal"),
        ({"choice": ("a", "b"), "relative": True}, "with relative = true; allowed: numbers"),
        ({"uniform": (0.0, float("nan"))}, "finite"),
    ],
)
def test_other_options_are_refused(options, message):
    with pytest.raises(ValidationError) as raised:
        UncertainOptions(**options)
    assert message in str(raised.value)


def test_a_normal_that_does_not_reach_its_limits_is_refused():
    with pytest.raises(ValueError, match="has practically no values between these limits"):
        UncertainOptions(normal=(0.0, 1e-3), limits=(1.0, 2.0)).quantile(0.5)
